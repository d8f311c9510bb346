"""The training loop.

A run is a folder: `config.json`, `state.pt` (everything that the next step depends on), `log.jsonl`, `pictures/`, and
at the end `pipeline/` with the averaged weights. Running the same command again resumes. With a length in steps the
losses after a resume are those of an uninterrupted run, bit for bit; with a length in minutes the learning rate follows
the clock.

Several processes run the same loop, each with its rows of every batch. Process 0 alone writes, speaks and looks at the
clock; weights, optimiser and random state are alike on all.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from torch import nn

from unirender.diffusion.schedule import make_scheduler
from unirender.errors import UnirenderError
from unirender.models.build import build_model
from unirender.models.packing import Maps
from unirender.system.ends import Ended
from unirender.training.config import OptimizerConfig, RunConfig, TrainConfig
from unirender.training.config_check import check_config
from unirender.training.data.source import BatchSource, NamesGroups
from unirender.training.logs.live import Report, standing
from unirender.training.logs.run_log import OVERFLOW, RunLog
from unirender.training.loop.beginning import Beginning
from unirender.training.loop.checkpoint import PICTURES, STATE_FILE, save_state, tidy
from unirender.training.loop.due import Due
from unirender.training.loop.pictures import SHEET_ROWS, save_sheet, training_sheet
from unirender.training.loop.state import check_alike, resume, state_of, write_config
from unirender.training.loop.stopping import StopRequest, stopping_gently
from unirender.training.loop.validation import Validate, Validation
from unirender.training.losses.loss_function import LossFunction
from unirender.training.optim.ema import Ema
from unirender.training.optim.loss_scale import LossScale
from unirender.training.optim.muon import make_optimizer
from unirender.training.optim.not_finite import too_large, wrong_data
from unirender.training.optim.passes import BatchGradient, Split
from unirender.training.optim.processes import ALONE, Processes


def learning_rate(config: OptimizerConfig, step: int, progress: float) -> float:
    """Linear warm-up by steps, then cosine decay by progress in [0, 1] to `final_lr` of the peak."""
    warmup = min(1.0, (step + 1) / (config.warmup_steps + 1))
    decay = config.final_lr + (1 - config.final_lr) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
    return config.learning_rate * warmup * decay


class Trainer:
    """One run: model, optimiser, average, random state and place in the data."""

    def __init__(
        self,
        config: TrainConfig,
        run: RunConfig,
        device: torch.device,
        dtype: torch.dtype,
        processes: Processes = ALONE,
        vae: AutoencoderKL | None = None,  # of a network on its latents; it is not trained
    ) -> None:
        if run.steps is None and run.minutes is None:
            raise UnirenderError("training: no length given, expected steps or minutes (or both)")
        check_config(config)
        self.config, self.run, self.device, self.dtype, self.processes = config, run, device, dtype, processes
        self.split = Split(config.batch_size, processes, run.parallel, run.accumulate)
        torch.manual_seed(config.seed)  # initial weights; everything later draws from self.generator
        self.vae = None if vae is None else vae.eval().requires_grad_(False)
        if self.vae is not None:
            nn.Module.to(self.vae, device)
        model, conditioning = build_model(config.model, self.vae)
        nn.Module.to(model, device)  # in place; ModelMixin hides the signature of its own `to`
        for p in model.parameters():
            if p.dim() == 4:
                p.data = p.data.contiguous(memory_format=torch.channels_last)
        self.model = model
        self.generator = torch.Generator().manual_seed(config.seed)
        self.loss = LossFunction(self.model, conditioning, make_scheduler(), config.loss, config.map_dropout)
        self.gradient = BatchGradient(self.loss, config, self.split, self.generator, dtype)
        self.loss_scale = LossScale(dtype)
        self.optimizer = make_optimizer(self.model, config.optimizer, self.gradient.pool)
        self.ema = Ema(self.model, config.optimizer.ema_decay)
        self.log = RunLog(run.out, processes)
        self.step = 0
        self.seconds = 0.0  # of training, over all resumes
        self.continues: list[dict[str, Any]] = []  # `training.json` of the runs that the weights come from
        self.begun_with: Beginning = {}
        self.source: BatchSource | None = None  # of the batches, once it trains
        self.shown: Maps = {}  # samples of the first batch: the same in every picture

    @property
    def progress(self) -> float:
        """Share of the run that is done, by steps or by the clock, whichever is further."""
        by_steps = self.step / self.run.steps if self.run.steps else 0.0
        by_clock = self.seconds / (60 * self.run.minutes) if self.run.minutes else 0.0
        return max(by_steps, by_clock)

    def begin_anew(self, continues: Sequence[dict[str, Any]]) -> None:
        """Begins with the weights that the model has now; `continues`: the runs that they come from."""
        self.ema = Ema(self.model, self.config.optimizer.ema_decay)
        self.continues = list(continues)

    def train_step(self, batch: Maps, when_idle: Callable[[], None] = lambda: None) -> dict[str, float]:
        """One optimiser step, on this process's rows of a batch; returns the loss terms of the whole batch.

        A step whose gradient overflowed float16 changes no weight, and has no loss terms.

        `when_idle` is called after the passes, when a CPU has one busy core left; it returns at once.

        Raises:
            UnirenderError: the gradient is not finite.
        """
        batch = {name: value.to(self.device) for name, value in batch.items()}
        rate = learning_rate(self.config.optimizer, self.step, self.progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.loss.cycle_scale = float(self.progress >= self.config.loss.cycle_warmup)
        self.loss.scale = self.loss_scale.value
        told = {"lr": rate} | ({"loss_scale": self.loss.scale} if self.loss_scale.is_dynamic else {})
        terms = self.gradient(batch)
        when_idle()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.optimizer.clip_norm)
        if torch.isfinite(norm):
            self.optimizer.step()
            self.ema.update(self.model)
            self.loss_scale.after_finite()
            told = terms | {"grad_norm": float(norm)} | told
        else:
            keys = self.source.last_keys() if isinstance(self.source, NamesGroups) else None
            why = wrong_data(batch, keys, self.processes)
            if why is None and not self.loss_scale.after_overflow():
                why = too_large((self.run.out / STATE_FILE).exists())
            if why is not None:
                raise UnirenderError(f"training: the gradient at step {self.step} is {float(norm)}; {why}")
        self.step += 1
        return told

    def fit(
        self,
        source: BatchSource,
        report: Report = lambda line: None,
        validate: Validate | None = None,
        say: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """Trains to the end of the run, resuming where the folder's state stands.

        Asked to stop (`unirender.training.loop.stopping`), it saves after the step that it is in.

        Args:
            source: of this process's rows of the batches.
            report: is told every line of the log.
            validate: scores a pipeline of the averaged weights, at the start, with every picture and at the end.
            say: is told where a run stands that is not new.

        Raises:
            Ended: it was asked to stop.
            UnirenderError: it cannot be written, a gradient is not finite, or the processes have different options.
        """
        self.source, main = source, self.processes.is_main
        check_alike(self)
        validation = Validation(validate, self.run.keep_best) if validate else None
        if main:
            tidy(self.run.out)
        if main and validation is not None:
            validation.begin(self)
        resumed = self.resume(source, report)
        self._start_alike(source)
        if resumed and main:
            say(standing(self.step, self.seconds / 60, self.run.steps, self.run.minutes))
        write_config(self)
        self._look(None, validation, report)
        due = Due(save=self.run.save_minutes, picture=self.run.picture_minutes, refresh=self.run.refresh_minutes)
        begun, logged = self.step, (self.step, self.seconds)
        with stopping_gently() as request:
            while self.progress < 1:
                refreshing, stopping = self._train_next(source, due, request)
                if self.step % self.run.log_every == 0 or self.progress >= 1:
                    with request.unheard():
                        self._tell_losses(*logged, report)
                    logged = self.step, self.seconds
                if main and (stopping is not None or due("save")):
                    self.save(source)
                if stopping is not None:
                    self.processes.share(None)  # all wait: when one has ended, torchrun ends the one that saves
                    raise Ended(stopping)
                with request.unheard():
                    if main and due("picture"):
                        self._look(self.shown, validation, report)
                    if refreshing:
                        self._refresh(source, report)
            if main:
                self.save(source)
            if (stopping := _first(self.processes.gather(request.signal))) is not None:
                raise Ended(stopping)
        if self.step > begun or not self._picture_file.exists():  # which a kill after the last save has prevented
            self._look(self.shown, validation, report)

    def _train_next(self, source: BatchSource, due: Due, request: StopRequest) -> tuple[bool, int | None]:
        """One step and its seconds: are there data to refresh (by process 0), and was any process asked to stop."""
        start = time.monotonic()  # pictures, validation and saves are no training
        batch = source.next()
        self.shown = self.shown or {name: value[:SHEET_ROWS].cpu().clone() for name, value in batch.items()}
        self.log.add(self.train_step(batch, source.read_ahead) | self.overflow(batch))
        seconds = self.seconds + time.monotonic() - start
        told = self.processes.gather((seconds, due("refresh"), request.signal))
        self.seconds, refreshing, _ = told[0]
        return refreshing, _first([signal for _, _, signal in told])

    def _tell_losses(self, step: int, seconds: float, report: Report) -> None:
        """Logs the means of the losses, and the speed since a step and its seconds of training."""
        speed = (self.step - step) * self.config.batch_size / (self.seconds - seconds)
        rates = {"step": self.step, "minutes": self.seconds / 60, "samples_per_s": speed}
        self.log.tell(rates | self.log.means(), report)

    def _look(self, shown: Maps | None, validation: Validation | None, report: Report) -> None:
        """Draws these samples, if there are any, and validates, if that is asked for and not done; process 0 alone."""
        if not self.processes.is_main:
            return
        if shown:
            self.picture(shown)
        if validation is not None and not validation.is_done(self):
            self.log.tell(validation.run(self), report)

    def _start_alike(self, source: BatchSource) -> None:
        """Gives all processes the weights, and the data, of process 0.

        Raises:
            UnirenderError: they do not see the same run folder.
        """
        steps = self.processes.gather(self.step)
        if len(set(steps)) > 1:
            raise UnirenderError(
                f"{self.run.out}: the processes begin at the steps {', '.join(map(str, steps))}, expected one; pass an "
                "--out that all machines share"
            )
        self.processes.copy_from_main(list(self.model.state_dict().values()))
        self._follow_main(source)

    def _follow_main(self, source: BatchSource) -> None:
        """Reads from the shards that process 0 reads from: a folder may grow while the processes look at it.

        What a machine has not packed yet its first process packs, before the others read it.

        Raises:
            UnirenderError: they are not there.
        """
        state = self.processes.share(source.state_dict())
        with self.processes.one_first():
            if self.processes.is_main:
                return
            try:
                source.load_state_dict(state)
            except UnirenderError as error:
                raise UnirenderError(
                    f"process {self.processes.rank} of {self.processes.size} does not find the data of process 0, "
                    f"expected one --data that all machines see ({error})"
                ) from error

    def _refresh(self, source: BatchSource, report: Report) -> None:
        """Takes in new shards; where they cannot be used, the run goes on with those that it has, and says so."""
        news = None
        try:
            news = source.refresh() if self.processes.is_main else None
        except UnirenderError as error:
            news = f"no new shards: {error}"
        if news := self.processes.share(news):
            self._follow_main(source)
            self.log.tell({"step": self.step, "data": news}, report)

    def overflow(self, batch: Maps) -> dict[str, float]:
        """Share of each HDR map's values above the brightest that its curve is made for; they are trained on as they
        are."""
        curves = self.loss.conditioning.packing.curves
        return {OVERFLOW + name: float((batch[name] > curve.x_max).float().mean()) for name, curve in curves.items()}

    def picture(self, batch: Maps) -> None:
        """Writes the picture of the averaged weights."""
        with self.averaged():
            sheet = training_sheet(self.loss, {name: value.to(self.device) for name, value in batch.items()})
        save_sheet(self._picture_file, sheet)

    @property
    def _picture_file(self) -> Path:
        """Of the picture at the present step."""
        return self.run.out / PICTURES / f"step_{self.step:06d}.png"

    @contextlib.contextmanager
    def averaged(self) -> Iterator[None]:
        """The model carries the averaged weights inside this block."""
        trained = [p.detach().clone() for p in self.model.parameters()]
        self.ema.copy_to(self.model)
        self.model.eval()
        try:
            yield
        finally:
            with torch.no_grad():
                for p, value in zip(self.model.parameters(), trained, strict=True):
                    p.copy_(value)
            self.model.train()

    def save(self, source: BatchSource) -> Path:
        """Writes everything that the next step depends on."""
        return save_state(self.run.out, state_of(self, source))

    def resume(self, source: BatchSource, report: Report = lambda line: None) -> bool:
        """As `unirender.training.loop.state.resume`."""
        return resume(self, source, report)


def _first(signals: Sequence[int | None]) -> int | None:
    """Of the signals of all processes, any of which may be asked to stop; None: none was."""
    return next((number for number in signals if number is not None), None)

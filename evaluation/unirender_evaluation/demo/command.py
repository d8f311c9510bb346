"""`unirender demo`. Light to import; the command loads what it needs when it runs."""

from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.errors import UnirenderError, UsageError

MOST_PORT = 65535


@dataclass(frozen=True)
class Demo:
    """A page in the browser: drop in a picture, see its maps, edit and relight it, and let Mitsuba check the result.

    Nothing leaves this machine: the page asks no other host, uploads are deleted as soon as they are read, and results
    are never written to a disk for longer than it takes to pack them.
    """

    host: str = "127.0.0.1"
    """Address to listen on. 0.0.0.0: whoever reaches this machine can use the page, without a password."""
    port: int = 7860
    """Port to listen on."""
    checkpoint: Path | None = None
    """Folder of a checkpoint (`unirender train` writes them), or a shipped one by its name. None: `tiny`."""
    device: Device = "auto"
    """Where the model runs. auto: cuda, then mps, then cpu, whichever is there."""
    max_megabytes: float = 32.0
    """Size of a file that is taken, picture, mask or light, in millions of bytes."""
    max_pixels: int = 40_000_000
    """Width times height of one."""
    max_seconds: float = 120.0
    """Time that a single request may take; it is stopped then."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, port=self.port, max_pixels=self.max_pixels)
        if self.port > MOST_PORT:
            raise UsageError(f"--port {self.port}: expected at most {MOST_PORT}")
        for name in ("max_megabytes", "max_seconds"):
            value = getattr(self, name)
            if not 0 < value < float("inf"):
                raise UsageError(f"--{name.replace('_', '-')} {value:g}: expected a number above 0")

    def run(self) -> int:
        """Serves until it is interrupted; returns the exit status.

        Raises:
            UnirenderError: gradio is not installed, the checkpoint is not there, or the address is not to be had.
        """
        self.check()
        if find_spec("gradio") is None:  # which `served` imports, after it has told it to be quiet
            raise UnirenderError("demo: gradio is not installed; pip install 'unirender[demo]'")
        from unirender_evaluation.demo.address import check_address

        check_address(self.host, self.port)
        from unirender_evaluation.demo.jobs import start
        from unirender_evaluation.demo.server import serve
        from unirender_evaluation.demo.uploads import Limits
        from unirender_evaluation.demo.worker import Worker

        print("unirender demo: loading the model; the address follows", flush=True)
        limits = Limits(self.max_megabytes, self.max_pixels, self.max_seconds)
        with Worker(partial(start, self.checkpoint, self.device, limits), self.max_seconds) as worker:
            serve(worker, limits, self.host, self.port)
        return 0

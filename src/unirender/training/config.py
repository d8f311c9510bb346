"""What a training is told: network, loss, optimiser, augmentation, run. Torch-free, as the command line needs it.

Rows of ready ones: `unirender.training.presets`; the ranges of the numbers: `unirender.training.config_check`.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from unirender.models.config import ModelConfig


@dataclass(frozen=True)
class LossConfig:
    """The loss; see `unirender.training.losses.loss_function`."""

    # squared error of [-1, 1] pictures, per triplet
    material: float = 1.0
    albedo: float = 2.0
    normal: float = 1.5
    specular: float = 2.0
    diffuse: float = 2.0
    environment: float = 0.5
    image: float = 4.0
    image_floor: float = 0.0  # squared error of an image above which its logarithm counts; 0: the squared error itself
    colour_floor: float = 0.0  # the same of albedo, s and d, each
    background: float = 0.02  # weight of a pixel outside the mask, beside 1 inside
    cycle: float = 1.0  # weight of the re-rendered image; 0: no cycle pass
    cycle_share: float = 0.25  # share of the inverse samples of a batch that are rendered again; 0: none
    cycle_into_renderer: bool = True  # the cycle's gradient also reaches the weights of the rendering pass
    cycle_warmup: float = 0.1  # share of the training before the cycle sets in
    composite: float = 0.0  # weight of the closed-form image of the predicted maps; 0: none


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW or Muon, linear warm-up, cosine decay."""

    kind: Literal["adamw", "muon"] = "adamw"  # muon: of hidden matrices; see `unirender.training.optim.muon`
    learning_rate: float = 1e-3
    beta1: float = 0.9
    beta2: float = 0.99
    weight_decay: float = 0.01
    warmup_steps: int = 100
    final_lr: float = 0.01  # of the learning rate, reached at the end; 1: constant
    clip_norm: float = 1.0
    ema_decay: float = 0.999


@dataclass(frozen=True)
class Augmentation:
    """How often each augmentation is drawn, and how strongly; see `unirender.training.augmentations`."""

    mix: float = 0.5  # probability that more than one light of a basis group is on
    max_lights: int = 3  # most lights in a mixture
    tint: float = 0.25  # largest standard deviation of the logarithm of a light's tint per channel; 0: none
    metallic: bool = True  # continuous metallic in basis groups; False: the stored nodes only
    permute: float = 0.3  # probability of a channel permutation other than the identity: lights have natural colours
    mirror: float = 0.5  # probability of a mirror flip
    turn: float = 0.15  # probability of a turn by 90, 180 or 270 degrees: rare, since light mostly comes from above
    expose: bool = True  # apply the gauge again with a newly drawn target; False: keep the stored exposure
    derived: float = 0.0  # probability that a renderer sees s and d derived from the light
    shadowed: float = 0.0  # share of these that has the shadows that the picture shows, and not none
    repaint: float = 0.0  # probability that an object takes on another's mean colour; close, not exact
    move: float = 0.0  # probability of a roll, a zoom and a shift; close; see `unirender.training.augmentations.moving`


@dataclass(frozen=True)
class TrainConfig:
    """A training run but for its data, its length and its folder."""

    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    augmentation: Augmentation = field(default_factory=Augmentation)
    batch_size: int = 16
    group_size: int = 1  # pictures side by side in a batch that differ in one thing only; 1: they may differ in all
    steps: int = 20_000  # length of a run where neither steps nor minutes are asked for; a resumed run may be prolonged
    timestep_rule: Literal["conditional", "algorithm1"] = "conditional"
    p_render: float = 0.5  # share of rendering; the paper's p_direction
    p_t: float = 0.5  # share of random t instead of T
    map_dropout: float = 0.0  # probability that each of albedo, s, d, environment is withheld when rendering
    seed: int = 0


@dataclass(frozen=True)
class RunConfig:
    """How long a run is and what it leaves behind. The run ends with whichever of `steps` and `minutes` comes first."""

    out: Path
    steps: int | None = None
    minutes: float | None = None  # of training, over all resumes
    log_every: int = 20  # steps
    save_minutes: float = 3.0
    picture_minutes: float = 5.0
    refresh_minutes: float | None = None  # look for new shards; None: never
    parallel: int = 1  # parts of a batch that run side by side, each on one CPU thread; changes the noise drawn
    accumulate: int = 1  # times that they do so for one step, to save memory; changes the noise drawn
    keep_best: str | None = None  # the score by which a validated run keeps its best pipeline in `best/`; None: none
    preset: str | None = None  # the row that the config began as, for the model card
    scored_on: str | None = None  # in words: what the validation measures on, for the model card

"""The presets: one table, a row per model. Torch-free, so that the command line can show and change them quickly.

`paper` is the recipe of the supplement, "Model Training"; `tiny` trains on two CPU cores. Ablations (paper
Sec. 4.3) are rows, not forks.
"""

import dataclasses

from unirender.errors import UnirenderError
from unirender.models.config import ModelConfig
from unirender.system.wording import one_of
from unirender.training.config import Augmentation, LossConfig, OptimizerConfig, TrainConfig

_TINY = TrainConfig(
    loss=LossConfig(cycle_into_renderer=False),
    # Close to natural light: it comes from above.
    augmentation=Augmentation(mix=0.4, tint=0.15, permute=0.1, turn=0.05),
    batch_size=24,
    p_render=0.4,
    p_t=0.15,
    map_dropout=0.03,
)
# Two of these have as many weights as `tiny`: each has two encoders and the decoder of its own direction.
_HALF_TINY = dataclasses.replace(
    _TINY.model, unified=False, block_out_channels=(56, 64, 80, 104), attention_head_dim=(4, 4, 4, 4), norm_num_groups=8
)
_TINY_RENDERER = dataclasses.replace(
    _TINY,
    model=dataclasses.replace(_TINY.model, derived_light=True),
    augmentation=dataclasses.replace(_TINY.augmentation, derived=0.3, shadowed=0.7),
    loss=dataclasses.replace(_TINY.loss, composite=1.0, image=20.0, image_floor=1e-3),
    optimizer=OptimizerConfig(kind="muon"),
    p_render=0.4,
)
_SMALL = dataclasses.replace(  # the network of `tiny_renderer`, whose weights it can begin with
    _TINY_RENDERER,
    model=dataclasses.replace(_TINY_RENDERER.model, resolution=128),
    loss=dataclasses.replace(_TINY_RENDERER.loss, colour_floor=1e-2, albedo=8.0, specular=6.0, diffuse=8.0),
    augmentation=dataclasses.replace(_TINY_RENDERER.augmentation, repaint=0.5),
    p_render=0.25,
)
# `tiny` with the loss of `small`, on many pictures: their light need not be derived, and few are rendered again.
_TINY_COLOUR = dataclasses.replace(
    _SMALL,
    model=_TINY_RENDERER.model,
    loss=dataclasses.replace(_SMALL.loss, cycle_share=0.125),
    augmentation=dataclasses.replace(_SMALL.augmentation, derived=0.0),
    batch_size=24,
)
# What `small` ships as: its network wider below the finest level, and with attention at the level above the lowest, on
# pictures moved in the frame, with more weight on materials and normals.
_SMALL_WIDE = dataclasses.replace(
    _SMALL,
    model=dataclasses.replace(_SMALL.model, block_out_channels=(64, 96, 128, 192), attention_levels=(2, 3)),
    loss=dataclasses.replace(_SMALL.loss, material=2.0, normal=3.0),
    augmentation=dataclasses.replace(_SMALL.augmentation, turn=0.0, move=0.5),
    optimizer=OptimizerConfig(kind="muon", learning_rate=3e-3, warmup_steps=50),
)
# It once more, on many objects with three pictures each: their light need not be derived, few are rendered again.
_SMALL_MORE = dataclasses.replace(
    _SMALL_WIDE,
    loss=dataclasses.replace(_SMALL_WIDE.loss, material=3.0, cycle_share=0.125),
    augmentation=dataclasses.replace(_SMALL_WIDE.augmentation, derived=0.0),
    optimizer=OptimizerConfig(kind="muon", learning_rate=1e-3, warmup_steps=50),
    batch_size=24,
    p_render=0.2,
)
_SD_MODEL = ModelConfig(
    resolution=512,
    codec="kl",
    patch=8,
    block_out_channels=(320, 640, 1280, 1280),
    layers_per_block=2,
    attention_levels=(0, 1, 2),
    attention_head_dim=(8, 8, 8, 8),
    cross_attention_dim=768,
    prompt_tokens=77,
    norm_num_groups=32,
    physics_prior="none",
)
_SD = TrainConfig(
    model=_SD_MODEL,
    optimizer=OptimizerConfig(
        learning_rate=1e-5, beta1=0.8, beta2=0.999, weight_decay=0.0, warmup_steps=0, final_lr=1.0, ema_decay=0.9999
    ),
    batch_size=4,
    steps=150_000,
)

PRESETS: dict[str, TrainConfig] = {
    "tiny": _TINY,
    "tiny_plain": dataclasses.replace(_TINY, model=dataclasses.replace(_TINY.model, physics_prior="none")),
    "tiny_composite": dataclasses.replace(_TINY, model=dataclasses.replace(_TINY.model, physics_prior="composite")),
    "tiny_without_cycle": dataclasses.replace(_TINY, loss=dataclasses.replace(_TINY.loss, cycle=0.0)),
    "tiny_cycle_into_renderer": dataclasses.replace(
        _TINY, loss=dataclasses.replace(_TINY.loss, cycle_into_renderer=True)
    ),
    "tiny_composite_loss": dataclasses.replace(_TINY, loss=dataclasses.replace(_TINY.loss, composite=1.0)),
    "tiny_muon": dataclasses.replace(
        _TINY,
        loss=dataclasses.replace(_TINY.loss, composite=1.0),
        optimizer=OptimizerConfig(kind="muon"),
        p_render=0.25,
    ),
    "tiny_renderer": _TINY_RENDERER,
    "tiny_colour": _TINY_COLOUR,
    "tiny_algorithm1": dataclasses.replace(_TINY, timestep_rule="algorithm1"),
    "tiny_one_at_a_time": dataclasses.replace(_TINY, group_size=8),
    "tiny_without_unified": dataclasses.replace(_TINY, model=_HALF_TINY),
    "small": _SMALL,
    "small_wide": _SMALL_WIDE,
    "small_more": _SMALL_MORE,
    "medium": dataclasses.replace(
        _TINY,
        model=ModelConfig(resolution=128, block_out_channels=(96, 128, 192, 256), layers_per_block=2),
        optimizer=OptimizerConfig(learning_rate=5e-4, ema_decay=0.9995),
    ),
    "sd15": _SD,
    "sd21": dataclasses.replace(
        _SD,
        model=dataclasses.replace(
            _SD_MODEL, attention_head_dim=(5, 10, 20, 20), cross_attention_dim=1024, linear_projection=True
        ),
    ),
    "paper": dataclasses.replace(_SD, loss=LossConfig(cycle_warmup=0.0, background=1.0)),
}


def get_preset(name: str) -> TrainConfig:
    """The named row.

    Raises:
        UnirenderError: no such row.
    """
    if name not in PRESETS:
        raise UnirenderError(f"preset: got {name!r}, {one_of(name, PRESETS)}")
    return PRESETS[name]

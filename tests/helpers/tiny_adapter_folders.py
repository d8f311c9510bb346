"""Very small folders of public pipelines with random weights, written by diffusers' own pipelines; what they answer."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.pipelines.marigold.pipeline_marigold_intrinsics import MarigoldIntrinsicsPipeline
from diffusers.pipelines.marigold.pipeline_marigold_normals import MarigoldNormalsPipeline
from diffusers.pipelines.stable_diffusion.pipeline_stable_diffusion_instruct_pix2pix import (
    StableDiffusionInstructPix2PixPipeline,
)
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from tiny_stable_diffusion import tiny_text_encoder, tiny_unet, tiny_vae, write_tokenizer
from transformers import CLIPTokenizer

Colour = tuple[float, float, float]
ANSWER = (0.6, 0.0, -0.2)  # of the decoder; 0.8, 0.5, 0.4 in [0, 1]
SIZE = (30, 21)  # no multiple of anything
LINEAR = {"prediction_space": "linear", "up_to_scale": False}
SCALED = {"prediction_space": "linear", "up_to_scale": True}
# As Marigold's published training configurations have them.
APPEARANCE = {
    "target_names": ["albedo", "material"],
    "albedo": {"prediction_space": "srgb"},
    "material": {"prediction_space": "stack", "sub_target_names": ["roughness", "metallicity", None]},
    "roughness": LINEAR,
    "metallicity": LINEAR,
}
LIGHTING = {
    "target_names": ["albedo", "shading", "residual"],
    "albedo": LINEAR,
    "shading": SCALED,
    "residual": SCALED,
}
# As the published file of RGB-to-X has it, zero terminal SNR and trailing steps aside, which it lacks.
SCHEDULE: dict[str, Any] = {
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "clip_sample": False,
    "prediction_type": "v_prediction",
    "set_alpha_to_one": False,
    "steps_offset": 1,
    "timestep_spacing": "leading",
}
TRAILING: dict[str, Any] = {"rescale_betas_zero_snr": True, "timestep_spacing": "trailing"}


def parts(words: Path, targets: int, answer: Colour | None = None, **schedule: Any) -> dict[str, Any]:
    """A network for a picture and some targets; with an `answer` its decoder says that colour, in [-1, 1], always."""
    unet, vae = tiny_unet(2, in_channels=4 * (targets + 1), out_channels=4 * targets), tiny_vae()
    if answer is not None:
        assert vae.decoder.conv_out.bias is not None
        torch.nn.init.zeros_(vae.decoder.conv_out.weight)
        vae.decoder.conv_out.bias.data = torch.tensor(answer)
    write_tokenizer(words)
    return {
        "unet": unet,
        "vae": vae,
        "scheduler": DDIMScheduler(**(SCHEDULE | schedule)),
        "text_encoder": tiny_text_encoder(unet.config["cross_attention_dim"]),
        "tokenizer": CLIPTokenizer.from_pretrained(str(words)),
    }


def write_intrinsics(folder: Path, properties: Mapping[str, Any], answer: Colour | None = None) -> Path:
    """A folder of Marigold's intrinsic images; all its targets have the answer, if any."""
    made = parts(folder.with_suffix(".words"), len(properties["target_names"]), answer, **TRAILING)
    pipeline = MarigoldIntrinsicsPipeline(
        **made,
        prediction_type="intrinsics",
        target_properties=dict(properties),
        default_denoising_steps=2,
        default_processing_resolution=24,
    )
    return _saved(pipeline, folder)


def write_normals(folder: Path, answer: Colour | None = None) -> Path:
    """A folder of Marigold's normals."""
    made = parts(folder.with_suffix(".words"), 1, answer, **TRAILING)
    pipeline = MarigoldNormalsPipeline(
        **made, prediction_type="normals", default_denoising_steps=2, default_processing_resolution=24
    )
    return _saved(pipeline, folder)


def write_rgbx(folder: Path, answer: Colour | None = None) -> Path:
    """A folder in the format of RGB-to-X: the parts are those of diffusers' other pipeline with 4 + 4 channels."""
    others: dict[str, Any] = {"safety_checker": None, "feature_extractor": None}
    made = parts(folder.with_suffix(".words"), 1, answer)
    return _saved(StableDiffusionInstructPix2PixPipeline(**made, **others, requires_safety_checker=False), folder)


def _saved(pipeline: Any, folder: Path) -> Path:
    """Writes a pipeline, the tokenizer as published folders have it: newer transformers write another file."""
    pipeline.save_pretrained(folder)
    shutil.rmtree(folder / "tokenizer")
    shutil.copytree(folder.with_suffix(".words"), folder / "tokenizer")
    return folder


def of_inside(value: np.ndarray, seen: dict[str, Any]) -> np.ndarray:
    """The one value that a map has inside the mask; it is 0 outside."""
    inside = seen["mask"][..., 0] > 0
    assert not value[~inside].any()
    assert np.ptp(value[inside], axis=0).max() < 1e-6
    return value[inside][0]

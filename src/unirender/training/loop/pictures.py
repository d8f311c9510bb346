"""The periodic picture of a training run: what the averaged weights make of a few samples."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from unirender.color import image_srgb
from unirender.diffusion.inference import infer_attributes, infer_image
from unirender.models.packing import TRIPLETS, Maps
from unirender.system.whole_files import whole_file
from unirender.system.writing import writing
from unirender.training.losses.loss_function import LossFunction

SHEET_ROWS = 4  # samples of a sheet
COLUMNS = ("image", "albedo", "normal", "material", "specular", "diffuse", "environment")


@torch.no_grad()
def training_sheet(loss: LossFunction, batch: Maps) -> UInt8[np.ndarray, "h w 3"]:
    """Two lines a sample, truth above prediction: image (rendered from true maps), then the maps (from the image)."""
    batch = {name: value[:SHEET_ROWS] for name, value in batch.items()}
    generator = torch.Generator().manual_seed(0)
    parts = (loss.model, loss.conditioning, loss.scheduler)
    given = torch.ones(len(batch["image"]), len(TRIPLETS), dtype=torch.bool, device=batch["image"].device)
    predicted = infer_attributes(*parts, batch["image"], batch["mask"], generator=generator)
    predicted["image"] = infer_image(*parts, batch, given, generator=generator)
    lines = []
    for i in range(len(batch["image"])):
        lines += [_line(batch, i, batch["mask"][i]), _line(predicted, i, batch["mask"][i])]
    return np.concatenate(lines)


def save_sheet(path: Path, sheet: UInt8[np.ndarray, "h w 3"]) -> None:
    """Writes a PNG; it appears complete."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file:
            Image.fromarray(sheet).save(file, format="PNG")


def _line(maps: Maps, row: int, mask: Float[Tensor, "1 H W"]) -> UInt8[np.ndarray, "H 7*W 3"]:
    """One sample's pictures side by side, in the order of `COLUMNS`."""
    size = tuple(mask.shape[-2:])
    cover = mask.permute(1, 2, 0).cpu().numpy()

    def array(name: str) -> np.ndarray:
        return maps[name][row].float().permute(1, 2, 0).cpu().numpy()

    pictures = {name: image_srgb(np.maximum(array(name), 0)) * cover for name in ("albedo", "specular", "diffuse")}
    pictures["image"] = image_srgb(array("image"))
    pictures["normal"] = (0.5 * array("normal") + 0.5) * cover
    pictures["material"] = np.concatenate([array("metallic"), array("roughness"), 0 * cover], axis=-1) * cover
    light = image_srgb(array("environment"))
    scale = max(1, size[1] // light.shape[1])
    light = light.repeat(scale, axis=0).repeat(scale, axis=1)
    pictures["environment"] = np.pad(light, ((0, size[0] - light.shape[0]), (0, size[1] - light.shape[1]), (0, 0)))
    row_of_pictures = np.concatenate([np.clip(pictures[name], 0, 1) for name in COLUMNS], axis=1)
    return (255 * row_of_pictures + 0.5).astype(np.uint8)

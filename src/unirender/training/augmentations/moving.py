"""Objects elsewhere in the frame: rolled about the view axis, nearer or farther, and to one side.

A roll is exact but for the resampling: normals and light turn with the picture, the light without losing or gaining
energy (`unirender.training.augmentations.environments`). Zoom and shift are close: seen from
another distance or side, an object would show a little more or less of its flanks, and a pixel's view direction changes
by up to 6 degrees of the 36 that the camera sees. An object that fills the frame may lose an edge of itself. What they
buy: an object of the training data is no longer bound to its place, and its outline falls on other pixels each time.

All but the light is resampled once, bilinearly. What is defined on the object alone (everything but image and mask) is
averaged over those of the four pixels that show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.sparse import block_diag
from torch import Tensor

from unirender.errors import UnirenderError
from unirender.models.packing import Maps
from unirender.training.augmentations.environments import ANGLE_STEP, small_turn_operator

ROLL_DEG = 25.0  # at most, either way
ZOOM = 0.18  # at most, the logarithm
SHIFT = 0.06  # at most, of the frame, one way
LEAST_COVERAGE = 1e-3  # less is a rounding error of where a pixel comes from


@dataclass(frozen=True)
class Move:
    """Of one sample: `roll` in radians, counter-clockwise as seen; `zoom` 1 and `shift` (0, 0) leave it where it is.

    `shift` is a fraction of the frame, to the right and down.
    """

    roll: float
    zoom: float
    shift: tuple[float, float]


def moved(maps: Maps, moves: Sequence[Move | None]) -> Maps:
    """Samples [b c h w] of a batch moved, but for those whose move is None.

    Args:
        maps: with mask; the maps of 1 x 1 pixel (flags) stay, the environment only turns.
        moves: one for each sample.

    Raises:
        UnirenderError: the frame is not square.
    """
    height, width = maps["mask"].shape[-2:]
    if height != width:
        raise UnirenderError(f"moves: got pictures of {height} x {width}, expected square ones to roll")
    chosen = [(row, move) for row, move in enumerate(moves) if move is not None]
    if not chosen:
        return maps
    rows = torch.tensor([row for row, _ in chosen], device=maps["mask"].device)
    roll, zoom, right, down = maps["mask"].new_tensor([(m.roll, m.zoom, *m.shift) for _, m in chosen]).unbind(dim=1)
    names = [n for n, value in maps.items() if n != "environment" and value.shape[-2:] == maps["mask"].shape[-2:]]
    part = _resampled({name: maps[name][rows] for name in names}, _grid(maps["mask"], roll, zoom, right, down))
    cosine, sine = (of(roll)[:, None, None] for of in (torch.cos, torch.sin))
    if "normal" in part:
        x, y, z = part["normal"].unbind(dim=1)
        part["normal"] = F.normalize(torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=1), dim=1)
    if "environment" in maps:
        part["environment"] = rolled_environment(maps["environment"][rows], [move.roll for _, move in chosen])
    return maps | {name: maps[name].index_copy(0, rows, value) for name, value in part.items()}


def rolled_environment(environment: Float[Tensor, "b 3 eh ew"], rolls: Sequence[float]) -> Float[Tensor, "b 3 eh ew"]:
    """Lights turned about +z, towards the viewer, in steps of a quarter of a degree, the first few of which
    hardly turn them; their energy is kept."""
    size = (environment.shape[-2], environment.shape[-1])
    operators = [small_turn_operator(size, round(roll / ANGLE_STEP)) for roll in rolls]
    matrix = block_diag(operators, format="coo")
    at = torch.from_numpy(np.stack(matrix.coords).astype(np.int64))
    turn = torch.sparse_coo_tensor(at, torch.from_numpy(matrix.data), matrix.shape, check_invariants=False)
    channels = environment.permute(0, 2, 3, 1).reshape(-1, 3)
    turned = torch.sparse.mm(turn.to(environment.device), channels)
    return turned.reshape(-1, *size, 3).permute(0, 3, 1, 2).contiguous()


def _grid(like: Tensor, roll: Tensor, zoom: Tensor, right: Tensor, down: Tensor) -> Float[Tensor, "b h w 2"]:
    """Where each pixel comes from, in [-1, 1]."""
    cosine, sine = roll.cos() / zoom, roll.sin() / zoom
    back = torch.stack([torch.stack([cosine, -sine], dim=1), torch.stack([sine, cosine], dim=1)], dim=1)
    offset = -back @ torch.stack([2 * right, 2 * down], dim=1)[..., None]
    size = [len(roll), 1, *like.shape[-2:]]
    return F.affine_grid(torch.cat([back, offset], dim=2), size, align_corners=False)


def _resampled(maps: Maps, grid: Float[Tensor, "b h w 2"]) -> Maps:
    shows = (maps["mask"] > 0).to(maps["mask"])

    def sampled(value: Tensor) -> Tensor:
        return F.grid_sample(value, grid, mode="bilinear", padding_mode="zeros", align_corners=False)

    mask, share = sampled(maps["mask"]).clamp(0, 1), sampled(shows)
    mask = torch.where(mask < LEAST_COVERAGE, 0, mask)
    inside = (mask > 0).to(mask) / share.clamp(min=1e-6)
    whole = {"image": lambda: sampled(maps["image"]), "mask": lambda: mask}
    return {name: whole.get(name, lambda name=name: inside * sampled(maps[name] * shows))() for name in maps}

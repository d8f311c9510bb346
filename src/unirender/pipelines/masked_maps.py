"""Maps under their mask: made, averaged, and brought back from premultiplied ones."""

import numpy as np
from jaxtyping import Float

from unirender.blocks import by_rows
from unirender.intrinsics import SHORTEST_NORMAL
from unirender.vectors import lengths

MIN_COVERAGE = 1e-3  # below it a resampled pixel carries no colour


def constant_map(
    value: Float[np.ndarray, "..."] | float, mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 1"]:
    """A number or a map as a map, 0 outside the mask."""
    return (np.broadcast_to(np.asarray(value, dtype=np.float32), mask.shape) * (mask > 0)).astype(np.float32)


def masked_mean(value: Float[np.ndarray, "h w 1"], mask: Float[np.ndarray, "h w 1"]) -> float:
    """Coverage-weighted mean of a map."""
    return float((value * mask).sum() / mask.sum())


def divide(premultiplied: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w c"]:
    """Undoes a premultiplication; 0 where there is no coverage."""
    return by_rows(_divided, premultiplied, mask)


def _divided(premultiplied: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w c"]:
    return np.where(mask > MIN_COVERAGE, premultiplied / np.maximum(mask, MIN_COVERAGE), 0).astype(np.float32)


def unit_normal(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Normals of length 1, also of those that `unirender.intrinsics.unit_normals` takes for unit ones; 0 stays 0."""
    return by_rows(_unit, normal)


def _unit(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    length = lengths(normal)
    return np.where(length > SHORTEST_NORMAL, normal / np.maximum(length, SHORTEST_NORMAL), 0).astype(np.float32)

"""Materials of a suite: spread evenly and independently over the grid of metallic and roughness levels.

Notation: m, r are metallic and (perceptual) roughness; a material is the pair (m, r).
"""

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError

MetallicRoughness = tuple[float, float]  # in this order, as in glTF
EVEN = 0.002  # by which the MSE of the constant may differ from that on the whole grid
DRAWS = 4096  # of a remainder, where the first is not even


def material_key(material: MetallicRoughness) -> str:
    """`(0.5, 0.3)` -> `m050_r030`: percent, no dots."""
    return f"m{round(100 * material[0]):03d}_{roughness_key(material[1])}"


def roughness_key(roughness: float) -> str:
    """`0.3` -> `r030`: percent, no dots."""
    return f"r{round(100 * roughness):03d}"


def stratified_materials(n_scenes: int, per_scene: int, levels: int, seed: int) -> list[list[MetallicRoughness]]:
    """Spreads `n_scenes * per_scene` materials evenly and independently over the `levels x levels` grid.

    Every cell of the grid is used equally often but for a remainder. The remainder of 240 over 121 cells is 2 x 121 -
    2: the two cells left out are (0.3, 0.9) and (0.9, 0.3), whose squared distances from 0.5 average 0.100, so that the
    constant 0.5 scores an MSE of exactly 0.100 for both. For other sizes the remainder is drawn at random, again where
    with it the constant would score much else than on the whole grid. Scenes are blocks over metallic: each gets one
    value from each fifth (for `per_scene` 5) of its range.

    Args:
        n_scenes: number of scenes.
        per_scene: materials of each scene, all different.
        levels: levels of metallic and of roughness, {0, 1/(levels-1), .., 1}.
        seed: of the assignment; the result is a pure function of the arguments.

    Returns:
        For each scene its list of (metallic, roughness).

    Raises:
        UnirenderError: there are too few levels for it.
    """
    rng = np.random.default_rng(seed)
    total, step = n_scenes * per_scene, levels - 1
    cells = [(m, r) for m in range(levels) for r in range(levels)]
    repeats, remainder = divmod(total, len(cells))
    pool = cells * repeats
    if levels == 11 and remainder == len(cells) - 2:
        pool += [cell for cell in cells if cell not in ((3, 9), (9, 3))]
    else:
        pool += [cells[i] for i in _even_remainder(np.array(cells) / step, repeats, remainder, rng)]
    for _ in range(1000):
        noise = rng.random(total)
        order = np.lexsort((noise, np.array([m for m, _ in pool])))
        columns = [rng.permutation(order[k * n_scenes : (k + 1) * n_scenes]) for k in range(per_scene)]
        scenes = [[pool[column[i]] for column in columns] for i in range(n_scenes)]
        if all(len(set(scene)) == per_scene for scene in scenes):
            return [[(m / step, r / step) for m, r in scene] for scene in scenes]
    raise UnirenderError(
        f"no assignment of {per_scene} different materials to each of {n_scenes} scenes on {levels} levels: "
        "use more levels"
    )


def _even_remainder(
    cells: Float[np.ndarray, "n 2"], repeats: int, remainder: int, rng: np.random.Generator
) -> Int[np.ndarray, " k"]:
    """Indices of `remainder` cells: the first draw that is even enough, else the most even of `DRAWS`.

    A draw is even where, with `repeats` of every cell beside it, the constant 0.5 scores what it scores on the grid.
    """
    squares = np.square(cells - 0.5)
    share = remainder / max(repeats * len(cells) + remainder, 1)

    def off(draws: Int[np.ndarray, "d k"]) -> Float[np.ndarray, " d"]:
        return share * np.abs(squares[draws].mean(axis=1) - squares.mean(axis=0)).max(axis=-1)

    first = rng.permutation(len(cells))[:remainder]
    if not remainder or off(first[None])[0] <= EVEN:
        return first
    draws = rng.permuted(np.tile(np.arange(len(cells)), (DRAWS, 1)), axis=1)[:, :remainder]
    return draws[np.argmin(off(draws))]

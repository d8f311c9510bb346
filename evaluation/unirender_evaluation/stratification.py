"""Materials of a suite: spread evenly and independently over the grid of metallic and roughness levels.

Notation: m, r are metallic and (perceptual) roughness; a material is the pair (m, r).
"""

from collections import Counter

import numpy as np

from unirender.errors import UnirenderError

Material = tuple[float, float]


def material_key(material: Material) -> str:
    """`(0.5, 0.3)` -> `m050_r030`: percent, no dots."""
    return f"m{round(100 * material[0]):03d}_{roughness_key(material[1])}"


def roughness_key(roughness: float) -> str:
    """`0.3` -> `r030`: percent, no dots."""
    return f"r{round(100 * roughness):03d}"


def stratified_materials(n_scenes: int, per_scene: int, levels: int, seed: int) -> list[list[Material]]:
    """Spreads `n_scenes * per_scene` materials evenly and independently over the `levels x levels` grid.

    Every cell of the grid is used equally often but for a remainder. The remainder of 240 over 121 cells is 2 x 121 -
    2: the two cells left out are (0.3, 0.9) and (0.9, 0.3), whose squared distances from 0.5 average 0.100, so that the
    constant 0.5 scores an MSE of exactly 0.100 for both. For other sizes the remainder is drawn at random. Scenes are
    blocks over metallic: each gets one value from each fifth (for `per_scene` 5) of its range.

    Args:
        n_scenes: number of scenes.
        per_scene: materials of each scene, all different.
        levels: levels of metallic and of roughness, {0, 1/(levels-1), .., 1}.
        seed: of the assignment; the result is a pure function of the arguments.

    Returns:
        For each scene its list of (metallic, roughness).
    """
    rng = np.random.default_rng(seed)
    total, step = n_scenes * per_scene, levels - 1
    cells = [(m, r) for m in range(levels) for r in range(levels)]
    repeats, remainder = divmod(total, len(cells))
    pool = cells * repeats
    if levels == 11 and remainder == len(cells) - 2:
        pool += [cell for cell in cells if cell not in ((3, 9), (9, 3))]
    else:
        pool += [cells[i] for i in rng.permutation(len(cells))[:remainder]]
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


def constant_mse(materials: list[list[Material]], value: float = 0.5) -> tuple[float, float]:
    """MSE that the constant `value` scores for (metallic, roughness) over all scenes' materials."""
    flat = np.array([material for scene in materials for material in scene])
    mse = np.mean((flat - value) ** 2, axis=0)
    return float(mse[0]), float(mse[1])


def level_counts(materials: list[list[Material]]) -> tuple[Counter, Counter]:
    """How often each level of metallic and of roughness occurs."""
    flat = [material for scene in materials for material in scene]
    return Counter(m for m, _ in flat), Counter(r for _, r in flat)

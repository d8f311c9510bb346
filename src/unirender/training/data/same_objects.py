"""Which groups of a data folder show one object, whatever their keys are.

Those of one name do (`X_g0`, `X_g1`, ...), and so does an object that is seen from several sides, since
`--turn-objects` adds the side to its name. Groups whose maps look alike do, too: a mesh may lie in two places, and have
two names.
"""

import re

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from unirender.training.data.dataset import GroupDataset

CELLS = 8  # along each side of a picture: means over them are compared
ALIKE = 0.01  # root mean square of the difference below which two look alike; another colour is more
_NUMBER = re.compile(r"_g\d+$")  # of a group
_TURNED = re.compile(r"-turned\d+$")


def object_of(key: str) -> str:
    """The object of a group, by its key: one object may have several."""
    return _TURNED.sub("", _NUMBER.sub("", key) or key)


def objects_of(data: GroupDataset) -> tuple[Int[np.ndarray, " groups"], list[tuple[str, str]]]:
    """The number of each group's object, from 0, and pairs of keys that look alike and have different names."""
    names = [object_of(key) for key in data.keys]
    looks = np.stack([_look(data, group) for group in range(len(names))])
    near = KDTree(looks).query_pairs(ALIKE * looks.shape[1] ** 0.5)
    alike = sorted((i, j) for i, j in near if names[i] != names[j])
    first = {name: i for i, name in reversed(list(enumerate(names)))}
    edges = np.array([*alike, *((i, first[name]) for i, name in enumerate(names))])
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(names), len(names)))
    return connected_components(graph, directed=False)[1], [(data.keys[i], data.keys[j]) for i, j in alike]


def _look(data: GroupDataset, group: int) -> Float[np.ndarray, " n"]:
    """Means of premultiplied albedo and normal, and of coverage, over the cells of a picture."""
    maps = data.surface(group)
    mask = maps["mask"]
    x = np.concatenate([maps["albedo"] * mask, maps["normal"] * mask, mask], axis=-1, dtype=np.float64)
    for axis in (0, 1):
        starts = np.arange(CELLS) * x.shape[axis] // CELLS
        sizes = np.diff(np.append(starts, x.shape[axis]))
        x = np.add.reduceat(x, starts, axis) / np.expand_dims(sizes, [i for i in range(3) if i != axis])
    return x.ravel()

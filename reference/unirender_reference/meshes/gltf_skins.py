"""Skins of a glTF in the pose in which its joints stand (glTF 2.0, section 3.7.3).

A skinned vertex lies where its joints carry it; the place of the mesh's own node does not count:

    v' = sum_k w_k W_k B_k v,    W_k the place of joint k in the world, B_k its inverse bind matrix, sum_k w_k = 1
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from unirender.blocks import BLOCK
from unirender.errors import UnirenderError
from unirender_reference.meshes.gltf_accessors import read_accessor
from unirender_reference.meshes.gltf_document import Document


@dataclass(frozen=True)
class Skin:
    """The joints of a skin.

    Attributes:
        matrices: W_k B_k of each.
    """

    matrices: Float[np.ndarray, "j 4 4"]

    def pose(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"] | None,
        joints: Int[np.ndarray, "n k"],
        weights: Float[np.ndarray, "n k"],
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"] | None, bool]:
        """Vertices and normals (of any length) where the joints carry them, and whether most of them are mirrored.

        Args:
            points: as they are stored.
            normals: likewise.
            joints: of each vertex; one without weight carries nothing, whatever its number.
            weights: of these joints.

        Raises:
            UnirenderError: a vertex hangs on a joint that is not there, or on none.
        """
        count, total = len(self.matrices), weights.sum(axis=1, keepdims=True)
        joints = np.where(weights == 0, 0, joints)
        if len(joints) and joints.max() >= count:
            raise UnirenderError(f"its vertices name joint {joints.max()}, its skin has {count}; export it again")
        if not (np.isfinite(weights).all() and (total > 0).all()):
            raise UnirenderError("has vertices whose weights of joints are all 0 or no numbers; export it again")
        weights = weights / total
        moved, turned, mirrored = np.empty_like(points), np.empty_like(points), 0
        for start in range(0, len(points), BLOCK):
            part = slice(start, start + BLOCK)
            blended = np.zeros((len(points[part]), 4, 4))
            for joint, weight in zip(joints[part].T, weights[part].T, strict=True):
                blended += weight[:, None, None] * self.matrices[joint]
            linear = blended[:, :3, :3]
            moved[part] = np.einsum("nij,nj->ni", linear, points[part]) + blended[:, :3, 3]
            inside_out = np.linalg.det(linear) < 0
            mirrored += int(inside_out.sum())
            if normals is not None:
                away = np.einsum("nij,nj->ni", cofactors(linear), normals[part])
                turned[part] = np.where(inside_out[:, None], -away, away)
        return moved, None if normals is None else turned, 2 * mirrored > len(points)


def cofactors(linear: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """What carries normals along, up to their length, also where a matrix has no inverse."""
    rows = [np.cross(linear[..., (i + 1) % 3, :], linear[..., (i + 2) % 3, :]) for i in range(3)]
    return np.stack(rows, axis=-2)


def read_skin(document: Document, index: object, place: Callable[[object], Float[np.ndarray, "4 4"]]) -> Skin:
    """A skin with its joints where their nodes stand.

    Args:
        document: the file.
        index: of the skin.
        place: where a node stands in the world.

    Raises:
        UnirenderError: it has no joints, or not as many bind matrices.
    """
    skin = document.item("skins", index)
    joints = skin.get("joints", [])
    if not joints:
        raise UnirenderError(f"skins[{index}] has no joints, expected some; export it again")
    world = np.stack([place(joint) for joint in joints])
    if "inverseBindMatrices" not in skin:
        return Skin(world)
    stored = read_accessor(document, skin["inverseBindMatrices"])
    if stored.shape[1] != 16 or len(stored) < len(joints):
        raise UnirenderError(
            f"skins[{index}] has {len(stored)} bind matrices of {stored.shape[1]} numbers for {len(joints)} joints, "
            "expected one of 16 for each; export it again"
        )
    bind = stored[: len(joints)].astype(np.float64).reshape(-1, 4, 4).swapaxes(1, 2)  # stored by columns
    return Skin(world @ bind)

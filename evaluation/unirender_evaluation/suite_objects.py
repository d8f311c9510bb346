"""The meshes behind a suite's scenes, made again by their generator, for rows that are told the true shape."""

from dataclasses import replace

import numpy as np

from unirender_evaluation.suites import Scene, Suite
from unirender_reference.shapes import MeshObject, make_object

GREY = 0.5  # base colour of a mesh that says nothing of the object's own


def scene_object(suite: Suite, scene: Scene) -> MeshObject:
    """The object of a scene, textures included."""
    return make_object(int(suite.provenance["objects"][scene.object]["seed"]), suite.spec.split)


def bare_mesh(obj: MeshObject) -> MeshObject:
    """The object's shape and texture coordinates without anything that it looks like: grey, no maps."""
    grey = np.full(3, GREY, np.float32)
    return replace(obj.without_maps(), albedo=grey, provenance={})


def known_mesh(suite: Suite, scene: Scene) -> MeshObject:
    """The bare mesh of a scene's object."""
    return bare_mesh(scene_object(suite, scene))

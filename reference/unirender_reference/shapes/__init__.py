"""Procedural objects: families of shapes, charts and textures behind `make_object`."""

from unirender_reference.shapes.generator import HELD_OUT_FAMILIES, TRAIN_FAMILIES, Split, make_object
from unirender_reference.shapes.mesh_object import MeshObject, Sphere, bounding_sphere, signed_volume, unit_sphere

__all__ = [
    "HELD_OUT_FAMILIES",
    "TRAIN_FAMILIES",
    "MeshObject",
    "Sphere",
    "Split",
    "bounding_sphere",
    "make_object",
    "signed_volume",
    "unit_sphere",
]

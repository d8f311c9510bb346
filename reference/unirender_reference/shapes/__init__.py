"""Procedural objects: families of shapes, charts and textures behind `make_object`."""

from unirender_reference.shapes.generator import HELD_OUT_FAMILIES, TRAIN_FAMILIES, Split, make_object
from unirender_reference.shapes.mesh_object import MeshObject, signed_volume, unit_sphere

__all__ = ["HELD_OUT_FAMILIES", "TRAIN_FAMILIES", "MeshObject", "Split", "make_object", "signed_volume", "unit_sphere"]

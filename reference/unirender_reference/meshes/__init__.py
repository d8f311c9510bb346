"""Users' meshes: found in folders (`find_meshes`), read completely and safely (`load_mesh`)."""

from unirender_reference.meshes.find import SUFFIXES, find_meshes
from unirender_reference.meshes.load import load_mesh, load_mesh_placed

__all__ = ["SUFFIXES", "find_meshes", "load_mesh", "load_mesh_placed"]

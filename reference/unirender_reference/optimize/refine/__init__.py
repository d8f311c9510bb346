"""Refinement of textures and light by Mitsuba's derivatives, from any start."""

"""Inverse rendering by optimisation: images in, mesh, textures and HDR environment out, through Mitsuba's derivatives.

Notation: a *view* is one picture with its camera; the world is that of the object, whose bounding sphere is centred at
the origin with radius 1; the environment is in world axes (+y up).
"""

"""Reconstruction: the mesh of an unknown object from posed pictures with masks.

The way: `hull` (soft masks -> grid -> mesh), `fit` (Gauss-Newton on the masks, with `silhouette` the outlines and their
derivative), `charts` (texture coordinates): `reconstruct`. Once light and materials are known, `refine_shape` moves the
vertices by the pictures (`shading`, `normal_matrix`). `measure` compares with a true object.

Notation: pixel coordinates (x, y) are continuous, x along the columns from the left edge of the frame, y down from its
top edge: the centre of pixel (row i, column j) is (j + 0.5, i + 0.5).
"""

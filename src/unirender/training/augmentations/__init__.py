"""Augmentations: other scenes, and other places in the frame, out of those that were rendered."""

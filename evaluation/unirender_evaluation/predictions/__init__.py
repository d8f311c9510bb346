"""Folders of somebody's predictions: their files, their conventions, and whether they can be scored."""

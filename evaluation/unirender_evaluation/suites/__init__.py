"""Suites: the objects, lights and materials of the scenes that a run scores."""

"""Optimisation: from a batch to its gradient, however it is cut, to new weights and their average."""

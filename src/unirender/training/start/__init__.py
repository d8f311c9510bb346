"""Starts: what the weights of a run begin with."""

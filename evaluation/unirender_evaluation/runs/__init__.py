"""Runs of the benchmark: what is asked for, which rows follow, who computes them, and what a run's folder gets."""

"""Commands that measure the ground truth: each prints what this run found, and nothing else."""

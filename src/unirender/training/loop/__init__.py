"""The loop: a run that trains, saves, goes on, validates, and leaves a pipeline with its card."""

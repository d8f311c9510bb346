"""What the model's prediction is worth as the start of a single-view optimisation: `bench warm-start`."""

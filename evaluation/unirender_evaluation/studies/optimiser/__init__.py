"""What the optimiser's ingredients are worth, and its race with a plain loop: `bench ingredients`, `bench race`."""

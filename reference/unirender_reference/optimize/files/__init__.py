"""Files of the optimiser: posed pictures in, the state of a run, and what it found."""

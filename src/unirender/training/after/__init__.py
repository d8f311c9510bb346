"""After training: checkpoints averaged, and calibrated on new objects."""

"""What a user sees of an optimisation: a live line, the report of its end, curves and strips of pictures."""

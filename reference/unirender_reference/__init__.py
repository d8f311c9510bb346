"""Ground truth: Mitsuba 3 renders of principled-BSDF scenes, with a stated noise floor."""

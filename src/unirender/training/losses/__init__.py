"""Losses: what is compared, and by which weights (paper Sec. 3.2)."""

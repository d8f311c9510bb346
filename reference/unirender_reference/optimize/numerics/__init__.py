"""Numerical tools that know nothing of light: differences of neighbours, robust losses, Adam on a pyramid."""

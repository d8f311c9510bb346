"""One picture: its maps and its light by optimisation."""

"""Light: environment maps, their scale, what is the same under any of them, and what a surface receives."""

"""What the machine has, where files lie, files that are whole, and processes that work together."""

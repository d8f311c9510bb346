"""The start by light transport: light, materials and base colour solved for together, without descent."""

"""Diffusion: the noise schedule, the timesteps of the two streams, and sampling."""

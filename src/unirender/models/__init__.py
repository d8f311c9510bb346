"""The networks: the dual-stream diffusion model, its latent codecs and the packing of maps into channels."""

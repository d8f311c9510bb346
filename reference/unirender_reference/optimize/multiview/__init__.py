"""Several posed views of one object: the stages from pictures to mesh, textures and light."""

"""What users call: the diffusers pipeline and the picture operations around it."""

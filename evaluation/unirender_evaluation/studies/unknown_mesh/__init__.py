"""Shape, material and light from posed pictures alone: `bench unknown-mesh`."""

"""Inner loops of a step outside the field, compiled for CPUs: pixels, poses, rays. Torch's operations define them."""

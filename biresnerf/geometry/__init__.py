"""Pure mathematics of rotations, poses and cameras. Opens no files and has no images."""

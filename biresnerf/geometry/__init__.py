"""Pure mathematics of rotations, poses and cameras. Opens no files; knows nothing of images."""

"""Cameras on a GPU: viewing directions of pixels, poses and rays."""

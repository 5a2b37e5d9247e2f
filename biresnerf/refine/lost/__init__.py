"""Cameras that are far off: found and brought home."""

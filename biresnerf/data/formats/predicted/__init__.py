"""Poses and lenses that networks predict in one go, for photos that they have scaled and cropped."""

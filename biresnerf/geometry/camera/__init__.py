"""Cameras: intrinsics, lens models, distortion, and the rays of pixels. Poses are not part of it."""

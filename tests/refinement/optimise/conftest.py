"""Loads the CUDA backend's kernels."""

from tests.field import interpreted_kernels  # noqa: F401

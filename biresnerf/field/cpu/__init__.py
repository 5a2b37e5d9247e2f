"""The field's CPU backend: kernels in Numba, tested against `reference`."""

"""The field's CUDA backend: kernels in Triton, tested against `reference`."""

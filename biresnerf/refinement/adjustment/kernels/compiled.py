"""How the adjustment's kernels are compiled: in float64, and without the fast-math flags that lose NaN and infinity."""

KERNEL = {"nogil": True, "error_model": "numpy", "cache": True, "fastmath": {"contract", "reassoc", "nsz"}}
# Of a point's 3 x 3 block, in cubes of its mean diagonal: about the squared parallax of its rays. With less, the point
# has no distance, and taking it out of the cameras' equations leaves rounding errors only.
LEAST_DETERMINANT = 1e-8

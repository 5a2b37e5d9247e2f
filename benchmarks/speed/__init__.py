"""Time and memory of the field's kernels, mostly as ratios against a reference in the same run: `make bench`."""

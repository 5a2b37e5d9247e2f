"""What `make bench` runs: speed and memory as ratios against a named reference in the same run."""

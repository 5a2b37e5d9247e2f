"""Joint optimisation of poses and field, from the start to the verdict. Reads and writes no scene files."""

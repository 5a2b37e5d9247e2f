"""What `biresnerf NAME` runs. No command holds logic that a library user would miss."""

"""What `biresnerf NAME` runs, one file per command; each is found by its entry point."""

"""`biresnerf compare` and `biresnerf study`."""

"""Generates pages from the code, so that they always agree with it: `python -m docs.generate` or `make docs`."""

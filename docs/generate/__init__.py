"""Pages that are made of the code, so that they cannot be wrong about it: `python -m docs.generate` or `make docs`."""

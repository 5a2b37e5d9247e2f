"""Photos that show all directions: detected by their metadata, and cut into views."""

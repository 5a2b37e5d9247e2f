"""Photos that show all directions: told by their metadata, and cut into views."""

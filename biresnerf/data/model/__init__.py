"""Image sets, COLMAP models and results in memory, and strict text and JSON. Knows no file format."""

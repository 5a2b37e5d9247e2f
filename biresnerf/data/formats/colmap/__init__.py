"""COLMAP models, binary and text: read and written without COLMAP, which only `seeding` runs."""

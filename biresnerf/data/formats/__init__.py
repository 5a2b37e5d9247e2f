"""File formats of poses, read and written, and which one a folder holds. Finds no poses of its own."""

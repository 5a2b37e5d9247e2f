"""Photos that Pillow alone does not read: what they are called, what reads them, and how their light becomes 8 bits."""

"""Image sets made from others whose poses are known: other lenses, other files, other sizes."""

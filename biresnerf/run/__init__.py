"""One run as a call: `biresnerf.refine`, how it shows its progress, and how Ctrl-C ends it."""

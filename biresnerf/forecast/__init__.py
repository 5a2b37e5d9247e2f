"""How long a run takes: what is left of it, and what a machine remembers of its speed. Without torch."""

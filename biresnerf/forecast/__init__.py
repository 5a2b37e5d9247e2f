"""How long a run takes: the time left, and the speed remembered for each machine. Without torch."""

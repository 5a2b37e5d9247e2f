"""Which poses the optimisation starts from, decided by short trials."""

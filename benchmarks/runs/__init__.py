"""Whole runs: where their time goes, and how well it is predicted."""

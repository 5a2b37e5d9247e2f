"""Levenberg-Marquardt over all cameras: what evidence offers it, how cameras may move, how exactly they are known."""

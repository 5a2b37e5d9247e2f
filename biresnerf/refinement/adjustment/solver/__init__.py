"""Levenberg-Marquardt over all cameras: the interface of evidence, how cameras may move, and their covariance."""

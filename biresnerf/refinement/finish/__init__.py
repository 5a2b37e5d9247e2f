"""After the last step: all cameras adjusted at once, and the choice of the poses that the result holds."""

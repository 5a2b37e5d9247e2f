"""First poses from feature matches: COLMAP in a child process, and guesses for what it cannot place."""

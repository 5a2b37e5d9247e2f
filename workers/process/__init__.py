"""Processes and what bounds them: child processes, watchdog, disk space, turns. Knows nothing of jobs."""

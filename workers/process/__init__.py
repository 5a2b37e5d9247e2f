"""Processes and their limits: child processes, watchdog, disk space, memory, turns. Knows nothing of jobs."""

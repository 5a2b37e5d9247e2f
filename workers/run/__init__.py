"""One attempt at one job: claimed, staged, run in a child process, its reports and result carried away."""

"""One attempt at one job: staged, run in a child process, its reports and result delivered."""

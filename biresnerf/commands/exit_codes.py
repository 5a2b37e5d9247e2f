"""Exit statuses; docs/command-line.md lists them."""

from __future__ import annotations

import signal
from typing import IO, Any

import click

DONE = 0
FAILED = 1  # none of the others: the optimisation diverged, a bug
INPUT = 2  # the input, an option, or the usage has to change
JOB = 3  # the job failed, was cancelled, or has expired
NOT_FOUND = 4  # no such job, dataset or file
KEY = 5  # the API key is missing, refused, or lacks the permission
AWAY = 6  # the service cannot be reached, or is busy
NOT_OVER = 7  # the job was not over after --timeout; it continues
SIGINT = 128 + signal.SIGINT
SIGTERM = 128 + signal.SIGTERM


class CommandFailed(click.ClickException):
    """Ends a command with one line on standard error and an exit status."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code  # type: ignore[misc]

    def show(self, file: IO[Any] | None = None) -> None:
        """Prints the line."""
        click.echo(f"error: {self.message}", file=file, err=file is None)

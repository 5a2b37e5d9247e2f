"""The exit statuses of engine processes; docs/operations.md has the table."""

from __future__ import annotations

from enum import IntEnum


class ExitStatus(IntEnum):
    """Statuses below 10 and above 20 hold for all processes; those between for `worker --one-job`."""

    DONE = 0  # of a one-job worker: its job succeeded
    SETUP = 2  # a setting or the usage is wrong
    NO_JOB = 10  # no job came in time, or the worker was stopped before
    JOB_FAILED = 11
    JOB_CANCELLED = 12
    STOPPED = 13  # SIGTERM or SIGINT: the job is back in the queue, and the attempt does not count
    GIVEN_BACK = 14  # crash, or disk or store unavailable: the job is back in the queue
    STUCK = 70  # the event loop hung for a minute, or database connections were lost
    FENCED = 75  # the job has another owner

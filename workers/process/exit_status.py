"""How an engine process says by its exit status what happened; docs/operations.md has the table."""

from __future__ import annotations

from enum import IntEnum


class ExitStatus(IntEnum):
    """Statuses below 10 and above 20 are the same for all processes; those between are of `worker --one-job`."""

    DONE = 0  # of a one-job worker: its job succeeded
    SETUP = 2  # a setting or the usage is wrong
    NO_JOB = 10  # none came in time, or the worker was stopped before it took one
    JOB_FAILED = 11
    JOB_CANCELLED = 12
    STOPPED = 13  # SIGTERM or SIGINT: the job is back in the queue, and the attempt does not count
    GIVEN_BACK = 14  # the attempt crashed, or disk or store were not there: the job is back in the queue
    STUCK = 70  # the event loop did nothing for a minute, or connections to the database were lost
    FENCED = 75  # the job has another owner

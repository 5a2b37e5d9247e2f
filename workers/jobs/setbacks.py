"""Why an attempt ended though its job is not over, and what that means for the job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from biresnerf.wire.problems import JobError

Cause = Literal["worker_lost", "killed", "error", "disk_full", "store_away"]
# Workers that a job may lose one after the other, likewise: most are stopped or frozen, some did the job take down.
LOSSES_PER_CRASH = 3
# Attempts of a job at most, in crashes that it may have one after the other: each of them may store a checkpoint first.
ATTEMPTS_PER_CRASH = 10


@dataclass(frozen=True)
class Setback:
    """One way for an attempt to end too early.

    Attributes:
        counts: as what, of which a job may have so many without a new checkpoint between them.
        what: what happened, after "The last time ".
        hint: what to do where it happened too often.
        message: what the job's owner reads while the job waits.
    """

    counts: Literal["crash", "loss"] | None
    what: str
    hint: str
    message: str = ""


SETBACKS: Mapping[Cause, Setback] = {
    "worker_lost": Setback(
        "loss",
        "the worker was lost: it was killed, or its machine stopped",
        "Submit the job again; tell the operator if that does not help.",
    ),
    "killed": Setback(
        "crash",
        "its process was killed, mostly for want of memory",
        "Try smaller options (preset fast, a smaller max_image_size) or a machine with more memory.",
    ),
    "error": Setback(
        "crash",
        "the program failed",
        "This is a fault of the program. Tell the operator the job's id: the worker's log has the details.",
    ),
    "disk_full": Setback(
        None,
        "the worker's disk was full or read-only",
        "Ask the operator for more room, or try a smaller max_image_size.",
        "Waiting: the worker's disk is full or read-only.",
    ),
    "store_away": Setback(
        None,
        "the file storage did not answer",
        "Tell the operator, and submit the job again later.",
        "Waiting: the file storage does not answer.",
    ),
}


def used_up(attempts: int, crashes: int, losses: int, max_attempts: int) -> bool:
    """Whether a job may not be tried again.

    After so many attempts, and so many crashes and lost workers since its last checkpoint.
    """
    return (
        crashes >= max_attempts
        or losses >= LOSSES_PER_CRASH * max_attempts
        or attempts >= ATTEMPTS_PER_CRASH * max_attempts
    )


def crashed_too_often(attempts: int, cause: Cause | None, log_tail: str = "") -> JobError:
    """The error of a job that may not be tried again; ``cause`` of the last attempt's end."""
    last = SETBACKS[cause or "error"]
    times = "once" if attempts == 1 else f"{attempts} times"
    return JobError(
        code="too_many_crashes",
        detail=f"The job was started {times} and did not end. The last time {last.what}.",
        hint=last.hint,
        log_tail=log_tail,
    )

"""Why an attempt ended before its job did, and the consequences for the job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from biresnerf.wire.problems import JobError

Cause = Literal["worker_lost", "killed", "error", "disk_full", "store_away"]
# Lost workers allowed, per allowed crash: most were stopped or frozen, some killed by the job.
LOSSES_PER_CRASH = 3
# Attempts allowed, per allowed crash: each may store a checkpoint, which resets the count of crashes.
ATTEMPTS_PER_CRASH = 10


@dataclass(frozen=True)
class Setback:
    """One way for an attempt to end too early.

    Attributes:
        counts: as a crash or a lost worker, of which a job may have so many between checkpoints; or not at all.
        what: what happened, after "The last time ".
        hint: what to do if it happens too often.
        message: shown to the job's owner while the job waits.
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
    """Whether a job has used up its attempts.

    Given its attempts, and the crashes and lost workers since its last checkpoint.
    """
    return (
        crashes >= max_attempts
        or losses >= LOSSES_PER_CRASH * max_attempts
        or attempts >= ATTEMPTS_PER_CRASH * max_attempts
    )


def crashed_too_often(attempts: int, cause: Cause | None, log_tail: str = "") -> JobError:
    """The error of a job that has used up its attempts; ``cause`` ended the last one."""
    last = SETBACKS[cause or "error"]
    times = "once" if attempts == 1 else f"{attempts} times"
    return JobError(
        code="too_many_crashes",
        detail=f"The job was started {times} and did not end. The last time {last.what}.",
        hint=last.hint,
        log_tail=log_tail,
    )

"""What the engine knows of jobs, files and uploads beyond what `biresnerf.wire` tells everybody. Frozen, torch-free."""

from __future__ import annotations

from datetime import datetime
from typing import Generic, TypeVar

from pydantic import Field

from biresnerf.wire.base import Record
from biresnerf.wire.datasets import UploadKind, UploadState
from biresnerf.wire.jobs import EventType, Job, JobEvent, PriorityName
from biresnerf.wire.problems import JobError

PRIORITIES: dict[PriorityName, int] = {"low": -1, "normal": 0, "high": 1}

LOG_NAME, POSES_NAME, REPORT_NAME = (
    "log.txt",
    "poses.json",
    "report.json",
)  # files of a result that the engine knows
THUMBNAIL_NAME = "thumbnail.jpg"
PREVIEW_FOLDER = "preview"  # of files that show how far a job is

FINAL_EVENTS: frozenset[EventType] = frozenset({"succeeded", "failed", "cancelled", "expired"})


def priority_name(number: int) -> PriorityName:
    """As clients say it."""
    return next(name for name, value in PRIORITIES.items() if value == number)


class JobUpdate(Record):
    """What a subscriber gets at every change: the job now, and the events since the last update."""

    job: Job
    events: tuple[JobEvent, ...] = ()


class Artifact(Record):
    """One file of a job's published result (or ``log.txt`` of a failed one). Read it by ``key``."""

    name: str = Field(description="Path relative to the result, for example renders/orbit.mp4.")
    key: str = Field(description="Key in the FileStore.")
    size: int
    sha256: str
    media_type: str

    @property
    def preview(self) -> bool:
        """Whether it shows a job that is not over yet; another one will take its place."""
        return self.name.startswith(f"{PREVIEW_FOLDER}/")


class DatasetFile(Record):
    """One file of a dataset. Read it by ``key``."""

    path: str
    key: str
    size: int
    sha256: str
    created_at: datetime


class Upload(Record):
    """Bytes on their way into a dataset: an archive, one file, or one file that is sent to the store itself."""

    id: str
    dataset_id: str
    kind: UploadKind
    path: str | None = Field(None, description="The file's path; none for an archive.")
    size: int
    sha256: str | None = Field(None, description="As announced; what arrives must have it.")
    state: UploadState
    received: int = Field(description="Bytes that are safe; the next byte to send has this number.")
    error: JobError | None = Field(None, description="Why it was rejected.")
    created_at: datetime
    expires_at: datetime = Field(description="It is given up then, unless it goes on.")
    folder: str = Field(description="Where its pieces lie in the FileStore.")


T = TypeVar("T")


class Page(Record, Generic[T]):
    """One page of a listing; ``next_cursor`` is opaque and none at the end."""

    items: tuple[T, ...]
    next_cursor: str | None = None

"""The records of the engine: those of `biresnerf.wire` and, never sent to clients, where files are stored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, Field

from biresnerf.wire.base import Record
from biresnerf.wire.datasets import FileView, UploadView
from biresnerf.wire.jobs import EventType, JobEvent, JobView, PriorityName
from biresnerf.wire.results import ResultFile

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

    job: JobView
    events: tuple[JobEvent, ...] = ()


class Artifact(ResultFile):
    """One file of a job's published result (or ``log.txt`` of a failed one). Read it by ``key``."""

    key: str = Field(description="Key in the FileStore.")

    @property
    def preview(self) -> bool:
        """Whether it shows a job that is not over yet; a later preview replaces it."""
        return self.name.startswith(f"{PREVIEW_FOLDER}/")


class DatasetFile(FileView):
    """One file of a dataset. Read it by ``key``."""

    key: str = Field(exclude=True)


class Upload(UploadView):
    """Bytes on their way into a dataset, and where their pieces are in the FileStore."""

    folder: str = Field(exclude=True)


T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)


class Page(Record, Generic[T]):
    """One page of a listing; ``next_cursor`` is opaque and none at the end."""

    items: tuple[T, ...]
    next_cursor: str | None = None


def record_from_row(model: type[Model], row: Mapping[str, Any], **others: Any) -> Model:
    """The record of a database row: its columns that are fields of ``model``, and ``others``."""
    return model.model_validate({name: row[name] for name in model.model_fields if name in row} | others)

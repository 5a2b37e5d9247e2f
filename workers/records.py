"""The engine's records: those of `biresnerf.wire`, plus the keys of stored files, which clients never get."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field

from biresnerf.wire.base import Page, Record
from biresnerf.wire.datasets import FileView, UploadView
from biresnerf.wire.jobs import JobEvent, JobView, PriorityName
from biresnerf.wire.results import ResultFile
from workers.database.ids import cursor_after, cursor_place, cursor_time

PRIORITIES: dict[PriorityName, int] = {"low": -1, "normal": 0, "high": 1}

# Files of a result that the engine uses.
LOG_NAME, POSES_NAME, REPORT_NAME = "log.txt", "poses.json", "report.json"
CRASH_NAME = "crash.txt"  # beside the log, for the operator alone
# With this exit status, a job's process asks for jobs with the options in this file, whose results it then joins.
EXIT_SPLIT, SPLIT_NAME = 6, "split.json"
THUMBNAIL_NAME = "thumbnail.jpg"
PREVIEW_FOLDER = "preview"  # of files that show a job's progress
# What pages show of a dataset: beside the folder that is checked, and in the file store.
SHOWN_FOLDER = "shown"
PHOTO_LIST, PHOTO_SHEET, FIRST_PHOTO = "photos.json", "view/contact_sheet.jpg", "thumbnail.jpg"


def shown_folder(checked: Path) -> Path:
    """The folder for what pages show of the set that is checked in ``checked``."""
    return checked.with_name(SHOWN_FOLDER)


def shown_key(dataset_id: str) -> str:
    """The key of its copy in the file store."""
    return f"datasets/{dataset_id}/{SHOWN_FOLDER}"


def priority_name(number: int) -> PriorityName:
    """The priority's name in the API."""
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
        """Whether it is a preview of an unfinished job, which a later preview replaces."""
        return self.name.startswith(f"{PREVIEW_FOLDER}/")


class DatasetFile(FileView):
    """One file of a dataset. Read it by ``key``."""

    key: str = Field(exclude=True)


class Upload(UploadView):
    """Bytes on their way into a dataset, and where their pieces are in the FileStore."""

    folder: str = Field(exclude=True)


T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)


# The end of a query for one page, newest first; its parameters come from `newest_first`.
NEWEST_FIRST = (
    " AND (%s::timestamptz IS NULL OR (created_at, id) < (%s, %s)) ORDER BY created_at DESC, id DESC LIMIT %s"
)


def newest_first(cursor: str | None, limit: int) -> tuple[datetime | str | int | None, ...]:
    """Parameters of `NEWEST_FIRST`: one row more than the page holds; raises `InputError` (``bad_cursor``)."""
    created, last_id = cursor_place(cursor, 2) if cursor else (None, None)
    after = cursor_time(created) if created else None
    return after, after, last_id, limit + 1


def page_of(found: Iterable[T], limit: int, order: tuple[str, ...] = ("created_at", "id")) -> Page[T]:
    """The first ``limit`` of the records; if there are more, the cursor holds the last one's ``order`` fields."""
    items = tuple(found)
    shown = items[:limit]
    more = len(items) > limit
    return Page(
        items=shown,
        next_cursor=cursor_after(*(getattr(shown[-1], name) for name in order)) if more else None,
    )


def record_from_row(model: type[Model], row: Mapping[str, Any], **others: Any) -> Model:
    """The record of a database row: its columns that are fields of ``model``, and ``others``."""
    return model.model_validate({name: row[name] for name in model.model_fields if name in row} | others)

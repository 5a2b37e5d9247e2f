"""What routes need of the running process, and the forms of ids and headers they share."""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi import Path as PathParameter

from service.http.metrics import WebMetrics
from service.http.problems import ProblemError
from workers.engine import Stores
from workers.process.disk_space import DiskBudget, upload_disk_budget
from workers.process.turns import Turns
from workers.settings.settings import Settings

# Archives that one process unpacks at the same time; each takes a core, and memory of its own.
UNPACKED_AT_ONCE = 4
_ID = re.compile(r"^[a-z]{2,3}_[0-9A-Za-z]{1,40}$", re.ASCII)


class UploadPlaces:
    """How many uploads each client may send at once, counted by each web process alone; 0 is no limit."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._taken: Counter[str] = Counter()

    @contextmanager
    def taken(self, client: str | None) -> Iterator[None]:
        """A place for as long as the context; none is needed where there is no client to count.

        Raises:
            ProblemError: ``too_many_uploads``: all are taken.
        """
        if client is None or not self._limit:
            yield
            return
        if self._taken[client] >= self._limit:
            raise ProblemError(
                "too_many_uploads",
                f"{self._limit} uploads are under way, which is the limit.",
                hint="Go on when one of them is done.",
            )
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]


@dataclass
class Service:
    """The running process: its settings, the engine, and what it has under way."""

    settings: Settings
    stores: Stores
    metrics: WebMetrics
    started: asyncio.Event = field(default_factory=asyncio.Event)
    closing: asyncio.Event = field(default_factory=asyncio.Event)
    background: set[asyncio.Task[Any]] = field(default_factory=set)
    unpacking: Turns = field(default_factory=lambda: Turns(UNPACKED_AT_ONCE))
    sending: UploadPlaces = field(init=False)

    def __post_init__(self) -> None:
        self.sending = UploadPlaces(self.settings.key_uploads)

    @property
    def staging_dir(self) -> Path:
        """Where bodies lie until they are checked."""
        return self.settings.data_dir / "staging"

    @property
    def disk_budget(self) -> DiskBudget:
        """What uploads may still take of the local disks."""
        return upload_disk_budget(self.settings)

    def keep_running(self, task: asyncio.Task[Any]) -> None:
        """Holds a task that outlives its request, so that it is not collected."""
        self.background.add(task)
        task.add_done_callback(self.background.discard)


def service_of(request: Request) -> Service:
    """The process that serves the request."""
    found: Service = request.app.state.service
    return found


CurrentService = Annotated[Service, Depends(service_of)]


def _known_form(identity: str) -> str:
    # Nothing of another form was ever given out; odd bytes must not reach the database.
    if not _ID.match(identity):
        raise ProblemError("not_found", f"There is no {identity[:60]!r}.")
    return identity


def _job_id(job_id: Annotated[str, PathParameter(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _known_form(job_id)


def _dataset_id(dataset_id: Annotated[str, PathParameter(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _known_form(dataset_id)


def _upload_id(upload_id: Annotated[str, PathParameter(examples=["up_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _known_form(upload_id)


def _webhook_id(webhook_id: Annotated[str, PathParameter(examples=["wh_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _known_form(webhook_id)


def _delivery_id(
    delivery_id: Annotated[str, PathParameter(examples=["msg_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])],
) -> str:
    return _known_form(delivery_id)


JobId = Annotated[str, Depends(_job_id)]
DatasetId = Annotated[str, Depends(_dataset_id)]
WebhookId = Annotated[str, Depends(_webhook_id)]
DeliveryId = Annotated[str, Depends(_delivery_id)]
UploadId = Annotated[str, Depends(_upload_id)]


def next_link(request: Request, cursor: str | None) -> dict[str, str]:
    """The `Link` header of a page that has a next one."""
    if cursor is None:
        return {}
    url = request.url.include_query_params(cursor=cursor)
    return {"Link": f'<{url.path}?{url.query}>; rel="next"'}

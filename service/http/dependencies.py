"""What routes depend on: the running process, ids in paths, and the header of a next page."""

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

# Archives that one process unpacks at a time; each takes a core and memory.
UNPACKED_AT_ONCE = 4
_ID = re.compile(r"^[a-z]{2,3}_[0-9A-Za-z]{1,40}$", re.ASCII)


class UploadLimit:
    """How many uploads each client may send at once, counted by each web process alone; 0 is no limit."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._running: Counter[str] = Counter()

    @contextmanager
    def counted(self, client: str | None) -> Iterator[None]:
        """Counts one upload of the client while the context lasts; without a client nothing is counted.

        Raises:
            ProblemError: ``too_many_uploads``: the limit is reached.
        """
        if client is None or not self._limit:
            yield
            return
        if self._running[client] >= self._limit:
            raise ProblemError(
                "too_many_uploads",
                f"{self._limit} uploads are under way, which is the limit.",
                hint="Continue when one of them is done.",
            )
        self._running[client] += 1
        try:
            yield
        finally:
            self._running[client] -= 1
            if not self._running[client]:
                del self._running[client]


@dataclass
class Service:
    """The running process: its settings, the engine, and its background tasks."""

    settings: Settings
    stores: Stores
    metrics: WebMetrics
    started: asyncio.Event = field(default_factory=asyncio.Event)
    closing: asyncio.Event = field(default_factory=asyncio.Event)
    background: set[asyncio.Task[Any]] = field(default_factory=set)
    unpacking: Turns = field(default_factory=lambda: Turns(UNPACKED_AT_ONCE))
    sending: UploadLimit = field(init=False)

    def __post_init__(self) -> None:
        self.sending = UploadLimit(self.settings.key_uploads)

    @property
    def staging_dir(self) -> Path:
        """Where bodies are stored until they are checked."""
        return self.settings.data_dir / "staging"

    @property
    def disk_budget(self) -> DiskBudget:
        """The disk space that uploads may still use."""
        return upload_disk_budget(self.settings)

    def keep_running(self, task: asyncio.Task[Any]) -> None:
        """Keeps a reference to a task that outlives its request, so that it is not garbage-collected."""
        self.background.add(task)
        task.add_done_callback(self.background.discard)


def service_of(request: Request) -> Service:
    """The service that handles the request."""
    found: Service = request.app.state.service
    return found


CurrentService = Annotated[Service, Depends(service_of)]


def _checked_id(identity: str) -> str:
    # No id has another form, and such bytes must not reach the database.
    if not _ID.match(identity):
        raise ProblemError("not_found", f"There is no {identity[:60]!r}.")
    return identity


def _job_id(job_id: Annotated[str, PathParameter(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _checked_id(job_id)


def _dataset_id(dataset_id: Annotated[str, PathParameter(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _checked_id(dataset_id)


def _upload_id(upload_id: Annotated[str, PathParameter(examples=["up_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _checked_id(upload_id)


def _webhook_id(webhook_id: Annotated[str, PathParameter(examples=["wh_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])]) -> str:
    return _checked_id(webhook_id)


def _delivery_id(
    delivery_id: Annotated[str, PathParameter(examples=["msg_01JD8Y3V1QKZ5M0C7W2N4T6XAB"])],
) -> str:
    return _checked_id(delivery_id)


JobId = Annotated[str, Depends(_job_id)]
DatasetId = Annotated[str, Depends(_dataset_id)]
WebhookId = Annotated[str, Depends(_webhook_id)]
DeliveryId = Annotated[str, Depends(_delivery_id)]
UploadId = Annotated[str, Depends(_upload_id)]


def next_link(request: Request, cursor: str | None) -> dict[str, str]:
    """The `Link` header of a page, if there is a next one."""
    if cursor is None:
        return {}
    url = request.url.include_query_params(cursor=cursor)
    return {"Link": f'<{url.path}?{url.query}>; rel="next"'}

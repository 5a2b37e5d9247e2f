"""What routes depend on: the running process, ids in paths, and pages of listings."""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Query, Request, Response
from fastapi import Path as PathParameter
from pydantic import AfterValidator, BaseModel

from biresnerf.wire.base import Page
from service.http.metrics import WebMetrics
from service.http.problems import ProblemError
from workers.engine import Stores
from workers.process.disk_space import DiskBudget, upload_disk_budget
from workers.process.memory_limits import MemoryShares, memory_limit, memory_shares
from workers.process.turns import Turns
from workers.settings.settings import Settings

Listing = TypeVar("Listing", bound=BaseModel)
# Bodies as they came; their values take about ten times as much, one body after the other.
JSON_BYTES_AT_ONCE = 32 * 2**20
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


class BodyLimit:
    """How many bytes of JSON bodies one web process holds at once, in all; each client may hold half.

    The first `FREE_BYTES` of each body are not counted, so that usual requests pass whoever sends large ones.
    """

    FREE_BYTES = 64 * 2**10

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._held: Counter[str | None] = Counter()

    @contextmanager
    def counted(self, client: str | None) -> Iterator[Callable[[int], None]]:
        """Counts one body while the context lasts; tell the function how many of its bytes there are.

        A body that is the only one may be larger than the limit. The function raises ``ProblemError``
        (``too_many_uploads``).
        """
        mine = 0

        def hold(size: int) -> None:
            nonlocal mine
            more = max(0, size - self.FREE_BYTES) - mine
            share = self._limit if client is None else self._limit // 2
            for held, limit in ((self._held.total(), self._limit), (self._held[client], share)):
                if more and held > mine and held + more > limit:
                    raise ProblemError(
                        "too_many_uploads",
                        f"The bodies under way have more than {limit} bytes, which is the limit.",
                        hint="Continue when one of them is done.",
                    )
            mine += more
            self._held[client] += more

        try:
            yield hold
        finally:
            self._held[client] -= mine
            if not self._held[client]:
                del self._held[client]


@dataclass
class Service:
    """The running process: its settings, the engine, and its background tasks."""

    settings: Settings
    stores: Stores
    metrics: WebMetrics
    started: asyncio.Event = field(default_factory=asyncio.Event)
    closing: asyncio.Event = field(default_factory=asyncio.Event)
    background: set[asyncio.Task[Any]] = field(default_factory=set)
    memory: MemoryShares = field(init=False)
    unpacking: Turns = field(init=False)
    decoding: Turns = field(init=False)
    sending: UploadLimit = field(init=False)
    bodies: BodyLimit = field(default_factory=lambda: BodyLimit(JSON_BYTES_AT_ONCE))

    def __post_init__(self) -> None:
        self.memory = memory_shares(memory_limit(), self.settings.processes)
        self.unpacking, self.decoding = Turns(self.memory.unpacks), Turns(self.memory.pictures)
        self.sending = UploadLimit(self.settings.key_uploads)

    @property
    def staging_dir(self) -> Path:
        """Where bodies are stored until they are checked."""
        return self.settings.data_dir / "staging"

    @property
    def disk_budget(self) -> DiskBudget:
        """The disk space that uploads may still use."""
        return upload_disk_budget(self.settings)

    def keep_running(self, work: Coroutine[Any, Any, object], name: str | None = None) -> None:
        """Runs work that outlives its request."""
        task = asyncio.create_task(work, name=name)
        self.background.add(task)  # else it could be garbage-collected
        task.add_done_callback(self.background.discard)


def service_of(request: Request) -> Service:
    """The service that handles the request."""
    found: Service = request.app.state.service
    return found


CurrentService = Annotated[Service, Depends(service_of)]


def _checked_id(identity: str) -> str:
    # Every id has this form; other bytes must not reach the database.
    if not _ID.match(identity):
        raise ProblemError("not_found", f"There is no {identity[:60]!r}.")
    return identity


_ID_FORM = AfterValidator(_checked_id)
JobId = Annotated[str, PathParameter(examples=["job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
BatchId = Annotated[str, PathParameter(examples=["bat_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
DatasetId = Annotated[str, PathParameter(examples=["ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
UploadId = Annotated[str, PathParameter(examples=["up_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
WebhookId = Annotated[str, PathParameter(examples=["wh_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
DeliveryId = Annotated[str, PathParameter(examples=["msg_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
LinkId = Annotated[str, PathParameter(examples=["lnk_01JD8Y3V1QKZ5M0C7W2N4T6XAB"]), _ID_FORM]
IfNoneMatch = Annotated[str | None, Header()]


def next_link(request: Request, cursor: str | None) -> dict[str, str]:
    """The `Link` header of a page, if there is a next one."""
    if cursor is None:
        return {}
    url = request.url.include_query_params(cursor=cursor)
    return {"Link": f'<{url.path}?{url.query}>; rel="next"'}


class Paging:
    """The requested page of a listing, and the response with it."""

    def __init__(
        self,
        request: Request,
        response: Response,
        limit: Annotated[int, Query(ge=1, le=200)] = 50,
        cursor: Annotated[str | None, Query(max_length=500)] = None,
    ) -> None:
        self.limit, self.cursor = limit, cursor
        self._request, self._response = request, response

    def respond(self, model: type[Listing], page: Page[Any]) -> Listing:
        """The page as ``model``, with the `Link` header to the next one."""
        self._response.headers.update(next_link(self._request, page.next_cursor))
        return model.model_validate({"items": page.items, "next_cursor": page.next_cursor})


Paged = Annotated[Paging, Depends()]

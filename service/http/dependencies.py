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

from biresnerf.machine import memory_limit
from biresnerf.wire.base import Page
from service.http.metrics import WebMetrics
from service.http.problems import ProblemError
from workers.engine import Stores
from workers.process.disk_space import DiskBudget, upload_disk_budget
from workers.process.memory_limits import MemoryShares, memory_shares
from workers.process.turns import Turns
from workers.settings.settings import Settings

Listing = TypeVar("Listing", bound=BaseModel)
# Of raw bodies. Parsed values take about ten times as much, but bodies are parsed one at a time.
JSON_BYTES_AT_ONCE = 32 * 2**20
JSON_FREE_BYTES = 64 * 2**10  # free for each body: ordinary requests pass while others send large ones
_ID = re.compile(r"^[a-z]{2,3}_[0-9A-Za-z]{1,40}$", re.ASCII)


class Held:
    """Limits how much of a resource clients hold at once; each web process counts its own.

    Args:
        what: the resource, in the plural.
        each: the most that one client may hold; 0 is no limit.
        in_all: the most that all may hold together; 0 is no limit.

    A single item may exceed a limit while nothing else is held.
    """

    def __init__(self, what: str, *, each: int, in_all: int = 0) -> None:
        self._what, self._each, self._in_all = what, each, in_all
        self._held: Counter[str | None] = Counter()

    @contextmanager
    def counted(self, client: str | None, amount: int = 0) -> Iterator[Callable[[int], None]]:
        """Counts one item while the context lasts; call the yielded function with its current amount.

        Both raise ``ProblemError`` (``too_many_uploads``). Without a client, only the total is limited.
        """
        mine = 0

        def hold(now: int) -> None:
            nonlocal mine
            more, each = now - mine, 0 if client is None else self._each
            for held, limit in ((self._held.total(), self._in_all), (self._held[client], each)):
                if limit and more > 0 and held > mine and held + more > limit:
                    raise ProblemError(
                        "too_many_uploads",
                        f"At most {limit} {self._what} are taken at once.",
                        hint="Continue when one of those under way is done.",
                    )
            mine = now
            self._held[client] += more

        try:
            hold(amount)
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
    sending: Held = field(init=False)
    bodies: Held = field(
        default_factory=lambda: Held("bytes of JSON", each=JSON_BYTES_AT_ONCE // 2, in_all=JSON_BYTES_AT_ONCE)
    )

    def __post_init__(self) -> None:
        self.memory = memory_shares(memory_limit(), self.settings.processes)
        self.unpacking, self.decoding = Turns(self.memory.unpacks), Turns(self.memory.pictures)
        self.sending = Held("uploads", each=self.settings.key_uploads)

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

"""A job's history and progress as server-sent events."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query
from fastapi.responses import StreamingResponse

from biresnerf.wire.problems import FieldProblem
from service.http.access import ReadCaller
from service.http.dependencies import JobId
from service.http.metrics import WebMetrics
from service.http.problems import ProblemError, declared
from workers.records import JobUpdate
from workers.settings.errors import NotFound, Unavailable

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["jobs"])
KEEP_ALIVE_S = 15.0
_RETRY_MS = 2000
# Another process may be there already; the job goes on.
_GOODBYE = ": this process is stopping; connect again with the last event's id\nretry: 500\n\n"
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": (
            "Events `queued`, `started`, `stage`, `checkpoint`, `preview`, `attempt_crashed`, "
            "`retried_smaller`, `requeued`, `cancel_requested`, `succeeded`, `failed`, `cancelled` carry an `id` "
            "and are never lost; "
            "`progress` carries the job as it is now, at most once a second. Comments keep the connection "
            "alive. The stream ends after the job."
        ),
        # OpenAPI 3.1 has no word for a stream: this is one event of it.
        "content": {
            "text/event-stream": {
                "schema": {
                    "type": "object",
                    "required": ["event", "data"],
                    "properties": {
                        "event": {"type": "string"},
                        "id": {"type": "string", "description": "Send it back as Last-Event-ID."},
                        "data": {"type": "string", "description": "JSON: a JobEvent, or the job (progress)."},
                    },
                },
                "example": {"event": "started", "id": "2", "data": '{"seq": 2, "type": "started"}'},
            }
        },
    }
}


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"


@router.get(
    "/events",
    operation_id="followJob",
    response_class=EventStream,
    responses={
        **_STREAM,
        **declared("not_found", "invalid_request", "database_unavailable", "internal_error"),
    },
)
async def follow_job(
    job_id: JobId,
    caller: ReadCaller,
    after: Annotated[
        int | None, Query(ge=0, le=2**31, description="Replay what came after this event.")
    ] = None,
    last_event_id: Annotated[str | None, Header(description="Sent by browsers when they reconnect.")] = None,
) -> EventStream:
    """Follows a job from its first event, or from after the one named by `after` or `Last-Event-ID`."""
    start = _start(after, last_event_id)
    updates = caller.jobs.subscribe(job_id, after=start, heartbeat_s=KEEP_ALIVE_S)
    # The first update before the answer begins: a missing job is a 404, not an empty stream.
    first = await anext(updates, None)
    headers = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
    events = _counted(_stream(first, updates, caller.service.closing), caller.service.metrics)
    return EventStream(events, headers=headers)


def _start(after: int | None, last_event_id: str | None) -> int:
    # The header is what a browser knows last, so it wins over the address it was opened with.
    if last_event_id is None or last_event_id == "":
        return after or 0
    if not last_event_id.isdecimal() or len(last_event_id) > 9:
        detail = "The id must be a number from this stream."
        raise ProblemError(
            "invalid_request", detail, errors=[FieldProblem(pointer="/header/Last-Event-ID", detail=detail)]
        )
    return int(last_event_id)


async def _counted(events: AsyncGenerator[str], metrics: WebMetrics) -> AsyncIterator[str]:
    """The events, with one listener more for as long as somebody follows them."""
    with metrics.listeners.track_inprogress():
        async with contextlib.aclosing(events):
            async for event in events:
                yield event


async def _stream(
    first: JobUpdate | None, updates: AsyncGenerator[JobUpdate | None], closing: asyncio.Event
) -> AsyncGenerator[str]:
    yield f"retry: {_RETRY_MS}\n\n"
    update: JobUpdate | None = first
    async with contextlib.aclosing(updates):
        while True:
            yield ": still here\n\n" if update is None else _written(update)
            if update is not None and update.job.final:
                return
            try:
                update = await _next_or_closing(updates, closing)
            except (_Ended, NotFound, Unavailable):
                # Deleted meanwhile, or the database is away: the client comes back and is told which.
                if closing.is_set():
                    yield _GOODBYE
                return


class _Ended(Exception):
    """There is nothing more to follow."""


async def _next(updates: AsyncGenerator[JobUpdate | None]) -> JobUpdate | None:
    async for update in updates:
        return update
    raise _Ended


async def _next_or_closing(
    updates: AsyncGenerator[JobUpdate | None], closing: asyncio.Event
) -> JobUpdate | None:
    """The next update; ends the iteration when the server shuts down."""
    coming = asyncio.ensure_future(_next(updates))
    end = asyncio.ensure_future(closing.wait())
    try:
        await asyncio.wait({coming, end}, return_when=asyncio.FIRST_COMPLETED)
        if coming.done():
            return coming.result()
        raise _Ended
    finally:
        for waiting in (coming, end):
            if not waiting.done():
                waiting.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await waiting


def _written(update: JobUpdate) -> str:
    """The update on the wire: its events with ids, and how far the job is (before the event that ends it)."""
    parts = [
        f"id: {event.seq}\nevent: {event.type}\ndata: {event.model_dump_json()}\n\n"
        for event in update.events
    ]
    progress = f"event: progress\ndata: {update.job.model_dump_json()}\n\n"
    if update.job.final and parts:
        return "".join([*parts[:-1], progress, parts[-1]])
    return "".join([*parts, progress])

"""A job's history and progress as server-sent events."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncGenerator, AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query
from fastapi.responses import StreamingResponse

from service.http.access import ReadCaller
from service.http.dependencies import JobId, Service
from service.http.problems import wrong_field
from workers.process.waiting import first_done
from workers.records import JobUpdate
from workers.settings.errors import NotFound, Unavailable

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["jobs"])
KEEP_ALIVE_S = 15.0
# Drawn anew for each stream: all that end with a process would come back together.
RETRY_MS = (1000, 5000)
# Another web process may be running already; the job continues.
_GOODBYE_MS = (500, 2500)
_GOODBYE = ": this process is stopping; connect again with the last event's id\n"
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": (
            "Events `queued`, `started`, `stage`, `checkpoint`, `preview`, `attempt_crashed`, "
            "`retried_smaller`, `requeued`, `cancel_requested`, `succeeded`, `failed`, `cancelled`, `expired` have an "
            "`id` and are never lost; `progress` contains the current job, at most once a second. "
            "Comments keep the connection alive. The stream ends when the job does."
        ),
        # OpenAPI 3.1 cannot describe a stream; this is one of its events.
        "content": {
            "text/event-stream": {
                "schema": {
                    "type": "object",
                    "required": ["event", "data"],
                    "properties": {
                        "event": {"type": "string"},
                        "id": {
                            "type": "string",
                            "description": "To resume the stream, send it as Last-Event-ID.",
                        },
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


@router.get("/events", response_class=EventStream, responses=_STREAM)
async def follow_job(
    job_id: JobId,
    caller: ReadCaller,
    after: Annotated[
        int | None, Query(ge=0, le=2**31, description="Replay what came after this event.")
    ] = None,
    last_event_id: Annotated[str | None, Header(description="Sent by browsers when they reconnect.")] = None,
) -> EventStream:
    """Streams the events of a job: all, or those after the event `after` or `Last-Event-ID`."""
    start = _start(after, last_event_id)
    updates = caller.jobs.subscribe(job_id, after=start, heartbeat_s=KEEP_ALIVE_S)
    # Read the first update before the response begins, so that a missing job is a 404, not an empty stream.
    first = await anext(updates, None)
    headers = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
    return EventStream(_stream(first, updates, caller.service), headers=headers)


def _start(after: int | None, last_event_id: str | None) -> int:
    # A browser that reconnects sends the header with the URL it first opened, so the header is newer.
    if last_event_id is None or last_event_id == "":
        return after or 0
    if not last_event_id.isdecimal() or len(last_event_id) > 9:
        raise wrong_field("/header/Last-Event-ID", "The id must be a number from this stream.")
    return int(last_event_id)


async def _stream(
    first: JobUpdate | None, updates: AsyncGenerator[JobUpdate | None], service: Service
) -> AsyncIterator[str]:
    update = first
    with service.metrics.listeners.track_inprogress():
        async with contextlib.aclosing(updates):
            yield _retry(RETRY_MS)
            while True:
                yield ": still here\n\n" if update is None else _as_text(update)
                if update is not None and update.job.final:
                    return
                try:
                    update = await _next_or_closing(updates, service.closing)
                except (StopAsyncIteration, NotFound, Unavailable):
                    # The job was deleted or the database is unavailable: the client reconnects and gets the error.
                    if service.closing.is_set():
                        yield _GOODBYE + _retry(_GOODBYE_MS)
                    return


def _retry(within_ms: tuple[int, int]) -> str:
    return f"retry: {random.randint(*within_ms)}\n\n"


async def _next_or_closing(
    updates: AsyncGenerator[JobUpdate | None], closing: asyncio.Event
) -> JobUpdate | None:
    """The next update; raises ``StopAsyncIteration`` when there is none, or when the service stops."""
    update = asyncio.ensure_future(anext(updates))
    try:
        await first_done(update, closing.wait())
        if update.done():
            return update.result()
        raise StopAsyncIteration
    finally:
        update.cancel()
        await asyncio.gather(update, return_exceptions=True)


def _as_text(update: JobUpdate) -> str:
    """The update as text: its events with their ids, and the progress (before the event that ends the job)."""
    parts = [
        f"id: {event.seq}\nevent: {event.type}\ndata: {event.model_dump_json()}\n\n"
        for event in update.events
    ]
    progress = f"event: progress\ndata: {update.job.model_dump_json()}\n\n"
    if update.job.final and parts:
        return "".join([*parts[:-1], progress, parts[-1]])
    return "".join([*parts, progress])

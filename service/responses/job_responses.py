"""A job as a response: body, ETag, Location and Retry-After."""

from __future__ import annotations

import asyncio
import re
from typing import Annotated

from fastapi import Header
from fastapi.responses import JSONResponse, Response
from pydantic import AfterValidator

from biresnerf.wire.jobs import JobView, job_url
from service.http.problems import ProblemError
from workers.jobs.jobs import JobStore
from workers.process.waiting import first_done

POLL_S = "2"
WAIT_MAX_S = 60.0
_KEY = re.compile(r"^[\x21-\x7e]{1,255}$")
_WAIT = re.compile(r"(?:^|[,;])\s*wait\s*=\s*\"?(\d{1,6})\"?\s*(?=$|[,;])", re.IGNORECASE)


def _checked_key(key: str | None) -> str | None:
    if key is not None and not _KEY.match(key):
        raise ProblemError("bad_idempotency_key", "The key must be 1 to 255 visible ASCII characters.")
    return key


IdempotencyKey = Annotated[
    str | None,
    Header(description="Repeating the request with the same key returns the same job."),
    AfterValidator(_checked_key),
]


def job_etag(job: JobView) -> str:
    """A weak ETag of the job's current state."""
    # Other jobs change the position of a queued job but not its revision. A browser may cache the job as its owner sees
    # it and as a link shows it.
    return f'W/"{job.revision}-{job.queue_position or 0}{"" if job.dataset_id else "-shared"}"'


def job_response(
    job: JobView, *, status: int = 200, new: bool = True, headers: dict[str, str] | None = None
) -> Response:
    """The response; ``new`` is False if an earlier request created the job."""
    made = {"ETag": job_etag(job), "Cache-Control": "no-cache"}
    if status == 202:
        made |= {"Location": job_url(job.id), "Retry-After": POLL_S}
    if not new:
        made["Idempotent-Replayed"] = "true"
    body = job.model_dump(mode="json")
    return JSONResponse(body, status_code=status, headers={**made, **(headers or {})})


def preferred_wait_s(prefer: str | None) -> float | None:
    """Seconds to wait by `Prefer: wait=N` (RFC 7240), at most `WAIT_MAX_S`; None without it."""
    found = _WAIT.search(prefer or "")
    return None if found is None else min(float(found[1]), WAIT_MAX_S)


async def waited_for(jobs: JobStore, job_id: str, seconds: float, closing: asyncio.Event) -> JobView:
    """Waits until the job ends, ``seconds`` pass or the service stops; returns the job."""
    waiting = asyncio.create_task(jobs.wait(job_id, timeout_s=seconds))
    try:
        await first_done(waiting, closing.wait())
        return await (waiting if waiting.done() else jobs.get(job_id))
    finally:
        waiting.cancel()

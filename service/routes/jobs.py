"""Jobs: submit, look, list, cancel, delete."""

from __future__ import annotations

import asyncio
import re
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import JSONResponse, Response

from service.access import Caller, CallerHere, JobWriterHere
from service.conditions import none_match
from service.dependencies import JobId, next_link
from service.json_body import json_content, read_json
from service.one_shot import submit_form
from service.problems import FieldProblem, ProblemError, declared
from service.schemas import JobList, JobView, NewJob, job_url
from workers.records import Job, JobState
from workers.waiting import first_done

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])
_ALWAYS = ("database_unavailable", "internal_error")
_WRITES = ("cross_site", *_ALWAYS)
_KEY = re.compile(r"^[\x21-\x7e]{1,255}$")
_POLL_S = "2"
_FORM: dict[str, Any] = {
    "schema": {
        "type": "object",
        "required": ["archive"],
        "additionalProperties": False,
        "properties": {
            "archive": {"type": "string", "format": "binary", "description": "zip, tar or tar.gz"},
            "options": json_content(NewJob)["schema"]["properties"]["options"],
            "labels": json_content(NewJob)["schema"]["properties"]["labels"],
        },
    },
    "encoding": {
        "options": {"contentType": "application/json"},
        "labels": {"contentType": "application/json"},
    },
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/json": json_content(NewJob), "multipart/form-data": _FORM},
    }
}


@router.post(
    "",
    status_code=202,
    operation_id="submitJob",
    response_model=JobView,
    openapi_extra=_BODY,
    responses=declared(
        *("malformed_json", "bad_idempotency_key", "not_found", "dataset_not_ready", "body_too_large"),
        *("unsupported_media", "invalid_options", "idempotency_key_reused", "archive_rejected", "queue_full"),
        *("storage_full", "body_timeout", *_WRITES),
    ),
)
async def submit_job(
    request: Request,
    caller: JobWriterHere,
    idempotency_key: Annotated[
        str | None, Header(description="The same key with the same request answers with the same job.")
    ] = None,
) -> Response:
    """Queues a refinement of a ready dataset, or of the archive in a multipart form."""
    if idempotency_key is not None and not _KEY.match(idempotency_key):
        raise ProblemError("bad_idempotency_key", "The key must be 1 to 255 visible ASCII characters.")
    kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if kind == "multipart/form-data":
        job, new = await submit_form(caller, request, idempotency_key)
    elif kind == "application/json":
        body = await read_json(kind, request.headers.get("content-length"), request.stream(), NewJob)
        job, new = await caller.jobs.submit(
            body.dataset_id, body.options, labels=body.labels, idempotency_key=idempotency_key
        )
    else:
        raise ProblemError(
            "unsupported_media",
            f"The Content-Type {kind!r} is neither application/json nor multipart/form-data.",
            where="Content-Type",
        )
    headers = {"Location": job_url(job.id), "Retry-After": _POLL_S}
    if not new:
        headers["Idempotent-Replayed"] = "true"
    return _answer(job, status=202, headers=headers)


@router.get("", operation_id="listJobs", responses=declared("bad_cursor", "invalid_request", *_ALWAYS))
async def list_jobs(
    request: Request,
    response: Response,
    caller: CallerHere,
    state: JobState | None = None,
    label: Annotated[str | None, Query(max_length=201, description="`name:value`")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    cursor: Annotated[str | None, Query(max_length=500)] = None,
) -> JobList:
    """Jobs, newest first."""
    page = await caller.jobs.list(state=state, label=_label(label), limit=limit, cursor=cursor)
    response.headers.update(next_link(request, page.next_cursor))
    return JobList(items=[JobView.of(job) for job in page.items], next_cursor=page.next_cursor)


def _label(text: str | None) -> tuple[str, str] | None:
    if text is None:
        return None
    name, colon, value = text.partition(":")
    if not colon or "\0" in text:
        detail = "A label is asked for as name:value."
        raise ProblemError(
            "invalid_request", detail, errors=[FieldProblem(pointer="/query/label", detail=detail)]
        )
    return name, value


@router.get(
    "/{job_id}",
    operation_id="getJob",
    response_model=JobView,
    responses={304: {"description": "As you have it."}, **declared("not_found", "invalid_request", *_ALWAYS)},
)
async def get_job(
    job_id: JobId,
    caller: CallerHere,
    wait: Annotated[
        float, Query(ge=0, le=60, description="Answer when the job is over, or after so many seconds.")
    ] = 0,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """The job now: state, stage, step, loss, seconds left, place in the queue."""
    job = await (_waited_for(caller, job_id, wait) if wait else caller.jobs.get(job_id))
    headers = {} if job.final else {"Retry-After": _POLL_S}
    if not none_match(if_none_match, _etag(job)):
        return Response(status_code=304, headers={"ETag": _etag(job), **headers})
    return _answer(job, headers=headers)


@router.post(
    "/{job_id}/cancel",
    operation_id="cancelJob",
    response_model=JobView,
    responses={
        202: {"model": JobView, "description": "Asked for; the job ends within seconds."},
        **declared("not_found", *_WRITES),
    },
)
async def cancel_job(job_id: JobId, caller: JobWriterHere) -> Response:
    """Ends a job. One that is over already stays as it is."""
    job = await caller.jobs.cancel(job_id)
    return _answer(job, status=200 if job.final else 202)


@router.delete(
    "/{job_id}",
    status_code=204,
    operation_id="deleteJob",
    responses=declared("not_found", "state_conflict", *_WRITES),
)
async def delete_job(job_id: JobId, caller: JobWriterHere) -> None:
    """Deletes a job that is over, with its results."""
    await caller.jobs.delete(job_id)


async def _waited_for(caller: Caller, job_id: str, seconds: float) -> Job:
    """The job when it is over, after so many seconds, or when the service stops."""
    waiting = asyncio.create_task(caller.jobs.wait(job_id, timeout_s=seconds))
    try:
        await first_done(waiting, caller.service.closing.wait())
        return await (waiting if waiting.done() else caller.jobs.get(job_id))
    finally:
        waiting.cancel()


def _etag(job: Job) -> str:
    # Others move a queued job's place without touching the job.
    return f'W/"{job.revision}-{job.queue_position or 0}"'


def _answer(job: Job, *, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    body = JobView.of(job).model_dump(mode="json")
    return JSONResponse(
        body, status_code=status, headers={"ETag": _etag(job), "Cache-Control": "no-cache", **(headers or {})}
    )

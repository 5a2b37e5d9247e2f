"""Jobs: submit, list, read, cancel, delete."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import Response
from pydantic import AwareDatetime

from biresnerf.wire.deliveries import DeliverTo
from biresnerf.wire.jobs import CancelJob, JobList, JobState, JobTexts, JobView, NewJob
from service.http.access import JobWriter, ReadCaller
from service.http.dependencies import IfNoneMatch, JobId, Paged
from service.http.http_conditionals import none_match
from service.http.link_access import shown_to_strangers
from service.http.problems import ProblemError, declared, wrong_field
from service.intake.json_body import JsonRoute, json_content, read_json, validate
from service.intake.one_shot import PLAIN, TEXTS, submit_form
from service.responses.job_responses import (
    POLL_S,
    IdempotencyKey,
    job_etag,
    job_response,
    preferred_wait_s,
    waited_for,
)

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=JsonRoute)
_FORM: dict[str, Any] = {
    "schema": {
        "type": "object",
        "required": ["archive"],
        "additionalProperties": False,
        "properties": {
            "archive": {"type": "string", "format": "binary", "description": "zip, tar or tar.gz"},
            **json_content(JobTexts)["schema"]["properties"],
        },
    },
    "encoding": {
        name: {"contentType": "text/plain" if name in PLAIN else "application/json"} for name in TEXTS
    },
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/json": json_content(NewJob), "multipart/form-data": _FORM},
    }
}
_DISCARD = CancelJob()


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    openapi_extra=_BODY,
    responses=declared(
        *("bad_idempotency_key", "not_found", "dataset_not_ready", "invalid_options"),
        *("idempotency_key_reused", "archive_rejected", "queue_full", "storage_full", "too_many_uploads"),
        *("webhook_url_refused", "priority_not_allowed", "quota_exhausted", "daily_limit_reached"),
        *("deadline_refused", "address_refused"),
        *("result_not_ready", "state_conflict", "expired"),
    )
    | {200: {"model": JobView, "description": "The job has ended; only with `Prefer: wait`."}},
)
async def submit_job(
    request: Request,
    caller: JobWriter,
    idempotency_key: IdempotencyKey = None,
    prefer: Annotated[
        str | None,
        Header(
            description="`wait=N` (at most 60): respond when the job has ended, or after N seconds.",
            examples=["wait=30"],
        ),
    ] = None,
) -> Response:
    """Queues a refinement of a ready dataset, or of the archive in a multipart form."""
    kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if kind == "multipart/form-data":
        job, new = await submit_form(caller, request, idempotency_key)
    elif kind == "application/json":
        async with read_json(request) as values:
            body = validate(values, NewJob)
        job, new = await caller.jobs.submit(**dict(body), idempotency_key=idempotency_key)
    else:
        raise ProblemError(
            "unsupported_media",
            f"The Content-Type {kind!r} is neither application/json nor multipart/form-data.",
            where="Content-Type",
        )
    wait_s = preferred_wait_s(prefer)
    if not wait_s:
        return job_response(job, status=202, new=new)
    job = await waited_for(caller.jobs, job.id, wait_s, caller.service.closing)
    applied = {"Preference-Applied": f"wait={wait_s:g}"}
    return job_response(job, status=200 if job.final else 202, new=new, headers=applied)


@router.get("")
async def list_jobs(
    caller: ReadCaller,
    paging: Paged,
    state: JobState | None = None,
    label: Annotated[str | None, Query(max_length=201, description="`name:value`")] = None,
    created_after: Annotated[
        AwareDatetime | None,
        Query(description="RFC 3339, with an offset.", examples=["2026-01-31T12:00:00Z"]),
    ] = None,
) -> JobList:
    """Refinements, newest first."""
    page = await caller.jobs.list(
        state=state,
        label=_label(label),
        created_after=created_after,
        limit=paging.limit,
        cursor=paging.cursor,
    )
    return paging.respond(JobList, page)


def _label(text: str | None) -> tuple[str, str] | None:
    if text is None:
        return None
    name, colon, value = text.partition(":")
    if not colon or "\0" in text:
        raise wrong_field("/query/label", "The label must have the form name:value.")
    return name, value


@router.get("/{job_id}", response_model=JobView, responses={304: {"description": "Not modified."}})
async def get_job(
    job_id: JobId,
    caller: ReadCaller,
    wait: Annotated[
        float, Query(ge=0, le=60, description="Respond when the job has ended, or after this many seconds.")
    ] = 0,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """The current job: state, stage, step, loss, seconds left, position in the queue."""
    jobs = caller.jobs
    job = await (waited_for(jobs, job_id, wait, caller.service.closing) if wait else jobs.get(job_id))
    if caller.link is not None:
        job = shown_to_strangers(job)
    headers = {} if job.final else {"Retry-After": POLL_S}
    if not none_match(if_none_match, job_etag(job)):
        return Response(status_code=304, headers={"ETag": job_etag(job), **headers})
    return job_response(job, headers=headers)


@router.post(
    "/{job_id}/cancel",
    response_model=JobView,
    responses={
        202: {"model": JobView, "description": "Cancellation is requested; the job ends within 10 seconds."},
    },
)
async def cancel_job(job_id: JobId, caller: JobWriter, body: CancelJob = _DISCARD) -> Response:
    """Cancels a job, with a partial result if requested. A job that has ended stays as it is."""
    job = await caller.jobs.cancel(job_id, keep_partial=body.keep_partial)
    return job_response(job, status=200 if job.final else 202)


@router.post(
    "/{job_id}/deliver",
    status_code=202,
    response_model=JobView,
    responses=declared("address_refused", "state_conflict", "expired"),
)
async def deliver_job(job_id: JobId, caller: JobWriter, body: DeliverTo) -> Response:
    """Sends files of the job to addresses by PUT, now or once it has ended; `delivered` holds the outcomes.

    A new address for a file replaces the previous one, for example one that has expired.
    """
    return job_response(await caller.jobs.deliver(job_id, body), status=202)


@router.delete("/{job_id}", status_code=204, responses=declared("state_conflict"))
async def delete_job(job_id: JobId, caller: JobWriter) -> None:
    """Deletes a job that has ended, with its results and exports."""
    await caller.jobs.delete(job_id)

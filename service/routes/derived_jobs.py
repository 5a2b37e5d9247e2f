"""What is made from a job: its log, the table of its images, forks, exports and parts."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query
from fastapi.responses import Response

from biresnerf.wire.jobs import ForkJob, JobList, JobView, NewExport, job_url
from biresnerf.wire.results import IMAGE_COLUMNS, ImageList, ImageRow
from service.http.access import Caller, JobWriter, ReadCaller
from service.http.dependencies import JobId
from service.http.problems import declared, wrong_field
from service.intake.json_body import JsonRoute
from service.responses.job_responses import POLL_S, IdempotencyKey, job_response
from service.routes.artifacts import find_report, whole_file
from workers.jobs.derived_jobs import DerivedJobs

router = APIRouter(
    prefix="/v1/jobs/{job_id}", tags=["jobs"], responses=declared("expired"), route_class=JsonRoute
)
LINES = "application/x-ndjson"
_LOG: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Lines, the oldest first. `Link: rel=next` leads to the following lines, if there can be any.",
        "content": {
            LINES: {"schema": {"type": "string"}, "example": '{"n": 1, "attempt": 1, "text": "6 images"}\n'},
            "text/plain": {"schema": {"type": "string"}, "example": "6 images\n"},
        },
    }
}


@router.get("/logs", response_class=Response, responses=_LOG)
async def get_job_log(
    job_id: JobId,
    caller: ReadCaller,
    after: Annotated[int, Query(ge=0, le=2**31, description="Lines after this one.")] = 0,
    limit: Annotated[int, Query(ge=1, le=10_000)] = 1000,
    form: Annotated[
        Literal["text", "ndjson"] | None, Query(alias="format", description="Default: as `Accept` says.")
    ] = None,
    accept: Annotated[str, Header()] = "",
) -> Response:
    """The log of the job's process, also while it runs."""
    # Read the state first, so that lines written in between are not missed.
    job = await caller.jobs.get(job_id)
    lines = await caller.jobs.log(job_id, after=after, limit=limit)
    headers = {"Cache-Control": "no-cache"}
    if not job.final or len(lines) == limit:
        last = lines[-1].n if lines else after
        chosen = f"&format={form}" if form else ""
        headers["Link"] = f'<{job_url(job_id)}/logs?after={last}&limit={limit}{chosen}>; rel="next"'
    if not job.final:
        headers["Retry-After"] = POLL_S
    if (form or ("ndjson" if LINES in accept else "text")) == "text":
        return Response("".join(f"{line.text}\n" for line in lines), media_type="text/plain", headers=headers)
    return Response(
        "".join(f"{line.model_dump_json()}\n" for line in lines), media_type=LINES, headers=headers
    )


@router.get("/images", responses=declared("result_not_ready", "storage_unavailable"), tags=["results"])
async def list_images(
    job_id: JobId,
    caller: ReadCaller,
    sort: Annotated[
        str,
        Query(
            max_length=60,
            description="A column, with `-` before it for the largest first.",
            examples=["-moved_deg"],
        ),
    ] = "",
    limit: Annotated[int, Query(ge=1, le=100_000)] = 100_000,
) -> ImageList:
    """The rows of the report's image table, in the dataset's order or sorted; unknown values come last."""
    column = sort.removeprefix("-")
    if column and column not in IMAGE_COLUMNS:
        detail = f"There is no column {column!r}; there are {', '.join(sorted(IMAGE_COLUMNS))}."
        raise wrong_field("/query/sort", detail)
    report = json.loads(await whole_file(caller, await find_report(caller, job_id)))
    return _image_rows(report, column, descending=sort.startswith("-"), limit=limit)


def _image_rows(report: dict[str, Any], column: str, *, descending: bool, limit: int) -> ImageList:
    """The rows sorted by a column of `IMAGE_COLUMNS`, or in the dataset's order; unknown values come last."""
    rows = [_row(image) for image in report["images"]]
    if column:
        known = [row for row in rows if getattr(row, column) is not None]
        known.sort(key=lambda row: getattr(row, column), reverse=descending)
        rows = known + [row for row in rows if getattr(row, column) is None]
    return ImageList(partial=report["state"] == "partial", items=rows[:limit])


def _row(image: dict[str, Any]) -> ImageRow:
    before, after = image.get("trial_psnr_before"), image.get("trial_psnr_after")
    gain = after - before if before is not None and after is not None else None
    return ImageRow.model_validate({**image, "delta_psnr": gain})


@router.post(
    "/fork",
    status_code=202,
    response_model=JobView,
    responses=declared(
        *("fork_not_possible", "dataset_not_ready", "invalid_options", "queue_full", "quota_exhausted"),
        *("bad_idempotency_key", "idempotency_key_reused", "storage_unavailable", "storage_full"),
        "daily_limit_reached",
    ),
)
async def fork_job(
    job_id: JobId, caller: JobWriter, body: ForkJob, idempotency_key: IdempotencyKey = None
) -> Response:
    """Queues a job on the same dataset with other options, reusing the result of a stage of this one."""
    changes = body.options.model_dump(mode="json", exclude_unset=True)
    job, new = await _derived(caller).fork(
        job_id, changes, body.from_stage, labels=body.labels, idempotency_key=idempotency_key
    )
    return job_response(job, status=202, new=new)


@router.post(
    "/exports",
    status_code=202,
    response_model=JobView,
    tags=["results"],
    responses=declared(
        *("result_not_ready", "state_conflict", "queue_full", "quota_exhausted", "daily_limit_reached"),
        "storage_full",
    )
    | {200: {"model": JobView, "description": "The same export was requested before and is complete."}},
)
async def export_job(job_id: JobId, caller: JobWriter, body: NewExport) -> Response:
    """Writes the result in additional formats; the files are then listed with those of the job.

    The response is a separate job, which can be followed and cancelled like any other. Repeating the request
    returns the same export.
    """
    job, new = await _derived(caller).export(job_id, body.formats, body.poses_of)
    return job_response(job, status=200 if job.final else 202, new=new)


@router.get("/exports", tags=["results"])
async def list_exports(job_id: JobId, caller: ReadCaller) -> JobList:
    """All exports of the job, the oldest first."""
    page = await _derived(caller).exports(job_id)
    return JobList(items=page.items)


@router.get("/parts")
async def list_parts(job_id: JobId, caller: ReadCaller) -> JobList:
    """The jobs that a job on a large set has split itself into, in order; none for most jobs.

    Each is an ordinary job on some of the photos, and cancelled with the whole.
    """
    page = await _derived(caller).parts(job_id)
    return JobList(items=page.items)


def _derived(caller: Caller) -> DerivedJobs:
    return DerivedJobs(caller.jobs, caller.service.stores.files)

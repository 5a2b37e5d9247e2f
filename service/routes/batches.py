"""Batches: submit many jobs at once, read them, cancel them."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import JSONResponse, Response

from biresnerf.wire.batches import BatchView, NewBatch, batch_url
from biresnerf.wire.jobs import CancelJob
from service.http.access import JobWriter, ReadCaller
from service.http.dependencies import BatchId
from service.http.problems import declared
from service.intake.json_body import JsonRoute
from service.responses.job_responses import POLL_S, IdempotencyKey
from workers.jobs.batches import Batches

router = APIRouter(prefix="/v1/batches", tags=["jobs"], route_class=JsonRoute)
_DISCARD = CancelJob()


@router.post(
    "",
    status_code=202,
    response_model=BatchView,
    responses=declared(
        *("bad_idempotency_key", "not_found", "dataset_not_ready", "invalid_options", "deadline_refused"),
        *("idempotency_key_reused", "queue_full", "quota_exhausted", "storage_full", "priority_not_allowed"),
        *("webhook_url_refused", "result_not_ready", "state_conflict", "expired", "daily_limit_reached"),
    ),
)
async def submit_batch(caller: JobWriter, body: NewBatch, idempotency_key: IdempotencyKey = None) -> Response:
    """Queues all of the jobs, or none of them if one is refused: `where` names it."""
    batch, new = await Batches(caller.jobs).submit_batch(body, idempotency_key=idempotency_key)
    replayed = {} if new else {"Idempotent-Replayed": "true"}
    return _response(batch, 202, {"Location": batch_url(batch.id), "Retry-After": POLL_S, **replayed})


@router.get("/{batch_id}", response_model=BatchView)
async def get_batch(batch_id: BatchId, caller: ReadCaller) -> Response:
    """Counts the batch's jobs by state, and lists the state and verdict of each."""
    batch = await Batches(caller.jobs).batch(batch_id)
    return _response(batch, 200, {} if batch.final else {"Retry-After": POLL_S})


@router.post(
    "/{batch_id}/cancel",
    response_model=BatchView,
    responses={202: {"model": BatchView, "description": "Cancellation is requested."}},
)
async def cancel_batch(batch_id: BatchId, caller: JobWriter, body: CancelJob = _DISCARD) -> Response:
    """Cancels the batch's jobs that have not ended, each with a partial result if requested."""
    batch = await Batches(caller.jobs).cancel_batch(batch_id, keep_partial=body.keep_partial)
    return _response(batch, 200 if batch.final else 202, {})


def _response(batch: BatchView, status: int, headers: dict[str, str]) -> Response:
    return JSONResponse(batch.model_dump(mode="json"), status, {"Cache-Control": "no-cache", **headers})

"""Links to single files of a result, for people and programs without a key."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import Response, StreamingResponse

from biresnerf.wire.results import NewShare, ShareView
from service.answers.downloads import ANSWERS, Asked, answer_with, find_artifact
from service.answers.share_links import require_signature, signature
from service.http.access import JobWriterHere
from service.http.dependencies import JobId, ServiceHere
from service.http.problems import declared
from service.intake.json_body import json_content, read_json

_POST = (
    *("malformed_json", "body_too_large", "unsupported_media", "body_timeout", "invalid_request"),
    *("not_found", "cross_site", "database_unavailable", "internal_error"),
)


async def _new_share(request: Request) -> NewShare:
    headers = request.headers
    return await read_json(
        headers.get("content-type", ""), headers.get("content-length"), request.stream(), NewShare
    )


router = APIRouter(prefix="/v1", tags=["results"])


@router.post(
    "/jobs/{job_id}/shares",
    status_code=201,
    operation_id="shareArtifact",
    responses=declared(*_POST),
    openapi_extra={
        "requestBody": {"required": True, "content": {"application/json": json_content(NewShare)}}
    },
)
async def share_artifact(
    job_id: JobId,
    caller: JobWriterHere,  # the link outlives the key that made it
    body: Annotated[NewShare, Depends(_new_share)],
    response: Response,
) -> ShareView:
    """A link to one file that needs no key and is good for a time. Whoever has the link has the file."""
    artifact = await find_artifact(caller.jobs, job_id, body.name)
    expires = int(time.time()) + body.valid_s
    signed = signature(caller.service.stores.share_key, job_id, artifact.name, expires)
    href = f"/v1/shared/{quote(job_id, safe='')}/{quote(artifact.name)}?expires={expires}&signature={signed}"
    response.headers["Location"] = href
    return ShareView(name=artifact.name, href=href, expires_at=datetime.fromtimestamp(expires, UTC))


@router.get(
    "/shared/{job_id}/{name:path}",
    operation_id="getShared",
    response_class=StreamingResponse,
    responses={**ANSWERS, **declared("link_expired")},
)
@router.head(
    "/shared/{job_id}/{name:path}",
    operation_id="headShared",
    response_class=StreamingResponse,
    responses={**ANSWERS, **declared("link_expired")},
)
async def get_shared(
    job_id: JobId,
    name: str,
    expires: Annotated[int, Query(ge=0, lt=2**40)],
    signed: Annotated[str, Query(alias="signature", max_length=100)],
    request: Request,
    service: ServiceHere,
    asked: Asked,
) -> Response:
    """The file of a link made by `POST /v1/jobs/{id}/shares`. Needs no key."""
    require_signature(service.stores.share_key, job_id, name, expires, signed)
    artifact = await find_artifact(service.stores.jobs, job_id, name)
    return await answer_with(service, artifact, asked, reading=request.method == "GET")

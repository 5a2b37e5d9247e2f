"""Links for people and programs without a key: signed ones to single files, and revocable ones to a job's page."""

from __future__ import annotations

import base64
import hashlib
import hmac
import time
from datetime import UTC, datetime
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Query
from fastapi.responses import Response, StreamingResponse

from biresnerf.wire.results import LinkList, LinkView, NewLink, NewLinkView, NewShare, ShareView
from service.http.access import JobWriter, ReadCaller
from service.http.dependencies import CurrentService, JobId, LinkId
from service.http.problems import ProblemError, declared
from service.intake.json_body import JsonRoute
from service.responses.downloads import (
    DOWNLOAD_RESPONSES,
    DownloadConditions,
    artifact_response,
    find_artifact,
)

router = APIRouter(prefix="/v1", tags=["results"], route_class=JsonRoute)
_SHARED = {**DOWNLOAD_RESPONSES, **declared("expired", "link_expired")}


@router.post("/jobs/{job_id}/shares", status_code=201)
async def share_artifact(
    job_id: JobId,
    caller: JobWriter,  # the link outlives the key that made it
    body: NewShare,
    response: Response,
) -> ShareView:
    """Creates a link to one file that needs no key and expires. Anyone with the link can read the file."""
    artifact = await find_artifact(caller.jobs, job_id, body.name)
    expires = int(time.time()) + body.valid_s
    current = await caller.links.share_round(job_id)
    signed = _signature(caller.service.stores.share_key, job_id, artifact.name, expires, current)
    href = f"/v1/shared/{quote(job_id, safe='')}/{quote(artifact.name)}?expires={expires}&signature={signed}"
    response.headers["Location"] = href
    return ShareView(name=artifact.name, href=href, expires_at=datetime.fromtimestamp(expires, UTC))


@router.delete("/jobs/{job_id}/shares", status_code=204)
async def revoke_shares(job_id: JobId, caller: JobWriter) -> None:
    """Revokes all links to single files of this job, from the next request on."""
    await caller.links.revoke_shares(job_id)


@router.post(
    "/jobs/{job_id}/links", status_code=201, responses=declared("quota_exhausted", "result_not_ready")
)
async def create_link(
    job_id: JobId,
    caller: JobWriter,  # the link outlives the key that made it
    body: NewLink,
) -> NewLinkView:
    """Creates a link that shows the page of this job to anyone who has it. It expires, and can be revoked."""
    link, token = await caller.links.create(job_id, body.valid_s)
    return NewLinkView(**link.model_dump(), token=token, page=f"/#/shared/{job_id}/{token}")


@router.get("/jobs/{job_id}/links")
async def list_links(job_id: JobId, caller: ReadCaller) -> LinkList:
    """The links to the page of this job that are still valid."""
    return LinkList(items=await caller.links.list(job_id))


@router.delete("/jobs/{job_id}/links/{link_id}", status_code=204)
async def revoke_link(job_id: JobId, link_id: LinkId, caller: JobWriter) -> None:
    """Revokes a link, from the next request on."""
    await caller.links.revoke(job_id, link_id)


@router.get("/jobs/{job_id}/link")
async def get_link(job_id: JobId, caller: ReadCaller) -> LinkView:
    """The link with which this request was made."""
    if caller.link is None:
        raise ProblemError("not_found", "This request was not made with a link.")
    return caller.link


@router.get("/shared/{job_id}/{name:path}", response_class=StreamingResponse, responses=_SHARED)
@router.head("/shared/{job_id}/{name:path}", response_class=StreamingResponse, responses=_SHARED)
async def get_shared(
    job_id: JobId,
    name: str,
    expires: Annotated[int, Query(ge=0, lt=2**40)],
    signed: Annotated[str, Query(alias="signature", max_length=100)],
    service: CurrentService,
    conditions: DownloadConditions,
) -> Response:
    """The file of a link created by `POST /v1/jobs/{id}/shares`. Needs no key."""
    current = await service.stores.links.share_round(job_id)
    made = _signature(service.stores.share_key, job_id, name, expires, current)
    _require_signature(made, expires, signed)
    artifact = await find_artifact(service.stores.jobs, job_id, name)
    return await artifact_response(service, artifact, conditions)


def _signature(key: bytes, job_id: str, name: str, expires: int, current: int) -> str:
    """The signature of this file name and expiry time with ``key``, in the job's ``current`` round."""
    message = "\n".join([f"biresnerf share {1 + current}", job_id, str(expires), name]).encode()
    return base64.urlsafe_b64encode(hmac.digest(key, message, hashlib.sha256)).decode().rstrip("=")


def _require_signature(made: str, expires: int, given: str) -> None:
    """Raises ``ProblemError``: ``not_found`` for a wrong or revoked signature, ``link_expired`` after its time."""
    if not hmac.compare_digest(made.encode(), given.encode(errors="replace")):
        raise ProblemError("not_found", "This service did not create this link, or it was revoked.")
    if expires < time.time():
        raise ProblemError("link_expired", "The link has expired.")

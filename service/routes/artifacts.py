"""The files of a result: list, download whole or in part."""

from __future__ import annotations

import base64
from collections.abc import AsyncIterator
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Header, Request
from fastapi.responses import Response, StreamingResponse

from biresnerf.report import Report
from service.access import Caller, CallerHere
from service.conditions import byte_range, none_match
from service.dependencies import JobId
from service.problems import ProblemError, declared
from service.schemas import ArtifactList, ArtifactView
from workers.records import Artifact

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["results"])
REPORT = "report.json"
_BINARY: dict[str, Any] = {
    # Each file in its own media type, which the list of artifacts tells.
    "content": {"*/*": {"schema": {"description": "The bytes."}}}
}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file.", **_BINARY},
    206: {"description": "The bytes asked for.", **_BINARY},
    304: {"description": "As you have it."},
}


@router.get(
    "/artifacts",
    operation_id="listArtifacts",
    responses=declared("not_found", "expired", "database_unavailable", "internal_error"),
)
async def list_artifacts(job_id: JobId, caller: CallerHere) -> ArtifactList:
    """All files of the result and of its exports. While the job runs, previews: the poses so far and a render."""
    found = await caller.jobs.artifacts(job_id)
    return ArtifactList(items=[ArtifactView.of(job_id, artifact) for artifact in found])


_DOWNLOAD = declared(
    "bad_range", "not_found", "expired", "range_not_satisfiable", "database_unavailable", "internal_error"
)


@router.get(
    "/artifacts/{name:path}",
    operation_id="getArtifact",
    response_class=StreamingResponse,
    responses={**_ANSWERS, **_DOWNLOAD},
)
@router.head(
    "/artifacts/{name:path}",
    operation_id="headArtifact",
    response_class=StreamingResponse,
    responses={**_ANSWERS, **_DOWNLOAD},
)
async def get_artifact(
    job_id: JobId,
    name: str,
    request: Request,
    caller: CallerHere,
    range_: Annotated[str | None, Header(alias="Range", description="`bytes=first-last`")] = None,
    if_range: Annotated[str | None, Header()] = None,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """One file. Its strong ETag is the SHA-256 of its bytes."""
    artifact = await _find(caller, job_id, name)
    etag = f'"{artifact.sha256}"'
    headers = _headers(artifact, etag)
    if not none_match(if_none_match, etag):
        return Response(status_code=304, headers=headers)
    part = byte_range(range_, if_range, etag, artifact.size) if request.method == "GET" else None
    first, last = part or (0, artifact.size - 1)
    headers["Content-Length"] = str(last - first + 1)
    if part:
        headers["Content-Range"] = f"bytes {first}-{last}/{artifact.size}"
    status = 206 if part else 200
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=artifact.media_type)
    content = await _opened(caller, artifact, first, last + 1)
    return StreamingResponse(content, status_code=status, headers=headers, media_type=artifact.media_type)


@router.get(
    "/report",
    operation_id="getReport",
    response_model=Report,
    responses=declared("not_found", "expired", "result_not_ready", "database_unavailable", "internal_error"),
)
async def get_report(job_id: JobId, caller: CallerHere) -> Response:
    """The machine-readable account of a finished job (the artifact `report.json`)."""
    artifact = await find_report(caller, job_id)
    content = await whole_file(caller, artifact)
    return Response(content, media_type="application/json", headers={"ETag": f'"{artifact.sha256}"'})


async def find_report(caller: Caller, job_id: str) -> Artifact:
    """The report's file; raises `ProblemError` (``result_not_ready``, ``not_found``)."""
    try:
        return await _find(caller, job_id, REPORT)
    except ProblemError:
        job = await caller.jobs.get(job_id)
        code = "not_found" if job.final else "result_not_ready"
        detail = f"The job {job.state} without a report." if job.final else f"The job is {job.state}."
        raise ProblemError(code, detail) from None


async def whole_file(caller: Caller, artifact: Artifact) -> bytes:
    """All bytes of a file that is small."""
    return b"".join([chunk async for chunk in caller.service.stores.files.read(artifact.key)])


async def _find(caller: Caller, job_id: str, name: str) -> Artifact:
    for artifact in await caller.jobs.artifacts(job_id):
        if artifact.name == name:
            return artifact
    raise ProblemError("not_found", f"The job has no file {name[:200]!r}.")


async def _opened(caller: Caller, artifact: Artifact, start: int, end: int) -> AsyncIterator[bytes]:
    """The byte stream, begun: a file that is gone makes a 404, not a broken answer."""
    await caller.service.stores.files.head(artifact.key)
    return caller.service.stores.files.read(artifact.key, start, end)


def _headers(artifact: Artifact, etag: str) -> dict[str, str]:
    base = artifact.name.rsplit("/", 1)[-1]
    plain = "".join(
        char if char.isascii() and char.isprintable() and char not in '"\\' else "_" for char in base
    )
    digest = base64.b64encode(bytes.fromhex(artifact.sha256)).decode()
    return {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        # Another preview will have the same name.
        "Cache-Control": "no-cache" if artifact.preview else "private, max-age=31536000, immutable",
        "Repr-Digest": f"sha-256=:{digest}:",
        # As an attachment always: what users sent must not run as a page of this origin.
        "Content-Disposition": f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(base, safe='')}",
        "X-Content-Type-Options": "nosniff",
    }

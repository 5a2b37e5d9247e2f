"""One file of a result as a response: whole, a range, not modified, or a redirect to the store."""

from __future__ import annotations

import base64
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import Depends, Header, Query, Request
from fastapi.responses import Response, StreamingResponse

from service.http.dependencies import IfNoneMatch, Service
from service.http.http_conditionals import byte_range, none_match
from service.http.problems import ProblemError, declared
from workers.jobs.jobs import JobStore
from workers.records import Artifact

_BINARY: dict[str, Any] = {
    # Each file has its own media type, which the list of artifacts contains.
    "content": {"*/*": {"schema": {"description": "The bytes."}}}
}
DOWNLOAD_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file.", **_BINARY},
    206: {"description": "The requested bytes.", **_BINARY},
    304: {"description": "Not modified."},
    307: {
        "description": "The file is at the signed address in `Location`, for some minutes and without a key.",
        "headers": {"Location": {"schema": {"type": "string"}}},
    },
    **declared(
        # Signed links need no key, so the codes of guarded operations are not theirs.
        *("bad_range", "expired", "range_not_satisfiable", "database_unavailable", "storage_unavailable")
    ),
}


class Conditions:
    """The conditions of a download; HEAD uses only ``If-None-Match``."""

    def __init__(
        self,
        request: Request,
        range_: Annotated[str | None, Header(alias="Range", description="`bytes=first-last`")] = None,
        if_range: Annotated[str | None, Header()] = None,
        if_none_match: IfNoneMatch = None,
        redirect: Annotated[
            bool,
            Query(description="`false`: do not redirect to the store, even if this service usually does."),
        ] = True,
    ) -> None:
        self.range, self.if_range, self.if_none_match = range_, if_range, if_none_match
        self.redirect, self.reading = redirect, request.method == "GET"


DownloadConditions = Annotated[Conditions, Depends()]


async def find_artifact(jobs: JobStore, job_id: str, name: str) -> Artifact:
    """The file of that name; raises ``ProblemError`` (``not_found``)."""
    for artifact in await jobs.artifacts(job_id):
        if artifact.name == name:
            return artifact
    raise ProblemError("not_found", f"The job has no file {name[:200]!r}.")


async def artifact_response(service: Service, artifact: Artifact, conditions: Conditions) -> Response:
    """The response to a GET or HEAD of the file."""
    etag = f'"{artifact.sha256}"'
    headers = _headers(artifact, etag)
    if not none_match(conditions.if_none_match, etag):
        return Response(status_code=304, headers=headers)
    if conditions.reading and conditions.redirect and service.settings.storage_presign:
        valid_s = service.settings.storage_presign_s
        found = await service.stores.files.signed_urls("GET", [artifact.key], valid_s)
        if found is not None:
            # A cache must not keep the address longer than it is valid.
            validators = {"ETag": etag, "Repr-Digest": headers["Repr-Digest"], "Cache-Control": "no-store"}
            return Response(status_code=307, headers={**validators, "Location": found[0]})
    part = None
    if conditions.reading:
        part = byte_range(conditions.range, conditions.if_range, etag, artifact.size)
    first, last = part or (0, artifact.size - 1)
    headers["Content-Length"] = str(last - first + 1)
    if part:
        headers["Content-Range"] = f"bytes {first}-{last}/{artifact.size}"
    status = 206 if part else 200
    if not conditions.reading:
        return Response(status_code=status, headers=headers, media_type=artifact.media_type)
    await service.stores.files.head(artifact.key)  # a missing file raises before the response begins
    content = service.stores.files.read(artifact.key, first, last + 1)
    return StreamingResponse(content, status_code=status, headers=headers, media_type=artifact.media_type)


def _headers(artifact: Artifact, etag: str) -> dict[str, str]:
    base = artifact.name.rsplit("/", 1)[-1]
    plain = "".join(
        char if char.isascii() and char.isprintable() and char not in '"\\' else "_" for char in base
    )
    digest = base64.b64encode(bytes.fromhex(artifact.sha256)).decode()
    return {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        # The next preview has the same name.
        "Cache-Control": "no-cache" if artifact.preview else "private, max-age=31536000, immutable",
        "Repr-Digest": f"sha-256=:{digest}:",
        # Always an attachment: what users sent must not run as a page of this origin.
        "Content-Disposition": f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(base, safe='')}",
        "X-Content-Type-Options": "nosniff",
    }

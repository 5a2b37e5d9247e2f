"""Resumable uploads: tus 1.0 (core, creation, expiration, termination).

https://tus.io/protocols/resumable-upload. This is the only file that knows the protocol.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import re
from datetime import UTC
from email.utils import format_datetime
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Request
from fastapi.responses import Response

from biresnerf.wire.datasets import UploadView, upload_url
from biresnerf.wire.safe_paths import checked_path
from service.http.access import DatasetWriter, ReadCaller
from service.http.dependencies import DatasetId, UploadId
from service.http.problems import ProblemError, declared
from service.intake.archive_import import start_import
from service.intake.uploads import limited_body, raw_request
from workers.records import Upload

VERSION = "1.0.0"
CONTENT_TYPE = "application/offset+octet-stream"
TUS_HEADERS = {"Tus-Resumable": VERSION}
_DIGEST = re.compile(r"[0-9a-f]{64}")
_METADATA = (
    "`name BASE64` pairs with commas between. `path`: the upload is this one file; without it, an archive. "
    "`sha256`: the digest of the whole upload, in hex."
)


def _check_tus_version(
    request: Request, tus_resumable: Annotated[str, Header(description="`1.0.0`; optional for GET.")] = ""
) -> None:
    """Adds the protocol version to every response, errors included; requests that tus defines must name it."""
    request.state.extra_headers = TUS_HEADERS
    if request.method not in {"GET", "OPTIONS"} and tus_resumable.strip() != VERSION:
        raise ProblemError(
            "precondition_failed",
            f"The header Tus-Resumable must be {VERSION}.",
            where="Tus-Resumable",
            headers={"Tus-Version": VERSION},
        )


router = APIRouter(
    prefix="/v1",
    tags=["uploads"],
    dependencies=[Depends(_check_tus_version)],
    responses=declared("precondition_failed", "storage_unavailable"),
)


def _upload_headers(upload: Upload) -> dict[str, str]:
    return {
        "Upload-Offset": str(upload.received),
        "Upload-Length": str(upload.size),
        "Upload-Expires": format_datetime(upload.expires_at.astimezone(UTC), usegmt=True),
        "Cache-Control": "no-store",
    }


@router.options("/datasets/{dataset_id}/uploads", status_code=204)
async def describe_uploads(dataset_id: DatasetId, caller: ReadCaller) -> Response:
    """Which parts of the tus protocol are supported."""
    headers = {
        "Tus-Version": VERSION,
        "Tus-Extension": "creation,expiration,termination",
        "Tus-Max-Size": str(caller.service.settings.max_archive_bytes),
    }
    return Response(status_code=204, headers=headers)


@router.post(
    "/datasets/{dataset_id}/uploads",
    status_code=201,
    responses=declared(
        *("dataset_not_open", "invalid_request", "unsafe_path", "body_too_large"),
        *("too_many_files", "storage_full", "quota_exhausted"),
    ),
)
async def create_upload(
    dataset_id: DatasetId,
    caller: DatasetWriter,
    response: Response,
    upload_length: Annotated[int, Header(ge=0, lt=2**62, description="Size of the upload in bytes.")],
    upload_metadata: Annotated[str, Header(description=_METADATA, max_length=8192)] = "",
) -> UploadView:
    """A new resumable upload of one archive (zip, tar, tar.gz) or one large file."""
    metadata = _metadata(upload_metadata)
    path, sha256 = metadata.get("path"), metadata.get("sha256")
    if sha256 is not None and not _DIGEST.fullmatch(sha256):
        raise ProblemError("invalid_request", "The value of sha256 is no SHA-256.", where="Upload-Metadata")
    await asyncio.to_thread(caller.service.disk_budget.require, upload_length)
    upload = await caller.uploads.create(
        dataset_id,
        "archive" if path is None else "file",
        upload_length,
        path=None if path is None else checked_path(path),
        sha256=sha256,
    )
    if upload.state == "received":
        start_import(caller.service, upload.id)
    response.headers.update({"Location": upload_url(upload.id), **_upload_headers(upload)})
    return upload


def _metadata(header: str) -> dict[str, str]:
    values = {}
    for pair in filter(None, (part.strip() for part in header.split(","))):
        name, _, value = pair.partition(" ")
        try:
            values[name] = base64.b64decode(value.strip(), validate=True).decode()
        except (binascii.Error, UnicodeDecodeError):
            raise ProblemError(
                "invalid_request", f"The value of {name[:50]!r} is no Base64 text.", where="Upload-Metadata"
            ) from None
    return values


@router.head("/uploads/{upload_id}")
async def head_upload(upload_id: UploadId, caller: ReadCaller) -> Response:
    """The offset at which the upload continues (`Upload-Offset`)."""
    return Response(status_code=200, headers=_upload_headers(await caller.uploads.get(upload_id)))


@router.get("/uploads/{upload_id}")
async def get_upload(upload_id: UploadId, caller: ReadCaller) -> UploadView:
    """The progress of the upload, and its outcome (`stored` or `rejected`) once all bytes are received."""
    return await caller.uploads.get(upload_id)


@router.patch(
    "/uploads/{upload_id}",
    status_code=204,
    responses=declared(
        *("offset_mismatch", "body_too_large", "unsupported_media", "invalid_request"),
        *("body_timeout", "storage_full", "too_many_uploads"),
    ),
    openapi_extra=raw_request(CONTENT_TYPE),
)
async def append_upload(
    upload_id: UploadId,
    request: Request,
    caller: DatasetWriter,
    upload_offset: Annotated[int, Header(ge=0, lt=2**62, description="Offset of the first byte sent.")],
) -> Response:
    """Appends bytes. If the connection breaks, those that arrived are kept; `HEAD` returns how many.

    After the last byte the upload is added to the dataset; an archive is unpacked completely or not at all.
    `POST …/finalize` waits for that and reports errors.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip() != CONTENT_TYPE:
        raise ProblemError("unsupported_media", f"The Content-Type must be {CONTENT_TYPE}.")
    uploads = caller.uploads
    upload = await uploads.get(upload_id)
    body = limited_body(request, max(upload.size - upload_offset, 0), caller.service.disk_budget)
    with caller.sending():
        upload = await uploads.append(upload_id, upload_offset, body)
    if upload.state == "received":
        start_import(caller.service, upload_id)
    return Response(status_code=204, headers=_upload_headers(upload))


@router.delete("/uploads/{upload_id}", status_code=204)
async def delete_upload(upload_id: UploadId, caller: DatasetWriter) -> None:
    """Deletes the upload. Files that it has already added to the dataset stay."""
    await caller.uploads.delete(upload_id)

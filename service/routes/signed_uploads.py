"""Files that clients send to the store, or that the service fetches.

For the store, clients get signed URLs; the service then verifies what arrived. Or the service fetches files from their
addresses.
"""

from __future__ import annotations

from fastapi import APIRouter

from biresnerf.wire.datasets import (
    FileView,
    NewFetches,
    NewSignedUploads,
    SignedUpload,
    SignedUploads,
    UploadList,
)
from biresnerf.wire.safe_paths import checked_path
from service.http.access import Caller, DatasetWriter, ReadCaller
from service.http.dependencies import DatasetId, UploadId
from service.http.problems import ProblemError, declared
from service.intake.json_body import JsonRoute
from workers.records import Upload
from workers.settings.errors import NotFound

router = APIRouter(prefix="/v1", tags=["uploads"], route_class=JsonRoute)


@router.post(
    "/datasets/{dataset_id}/signed-uploads",
    status_code=201,
    responses=declared(
        *("direct_upload_unavailable", "dataset_not_open", "too_many_files"),
        *("unsafe_path", "quota_exhausted", "storage_unavailable"),
    ),
)
async def sign_uploads(dataset_id: DatasetId, caller: DatasetWriter, body: NewSignedUploads) -> SignedUploads:
    """Creates a signed URL at the store for each file. `PUT` the bytes there, then `POST …/complete` here."""
    await caller.datasets.get(dataset_id)
    paths = [checked_path(file.path) for file in body.files]
    await _addresses(caller, [])  # refuse before anything is created
    uploads = [
        await caller.uploads.create(dataset_id, "signed", file.size, path=path, sha256=file.sha256)
        for file, path in zip(body.files, paths, strict=True)
    ]
    urls = await _addresses(caller, [_key(upload) for upload in uploads])
    items = [SignedUpload(upload=upload, url=url) for upload, url in zip(uploads, urls, strict=True)]
    return SignedUploads(items=items)


async def _addresses(caller: Caller, keys: list[str]) -> list[str]:
    settings = caller.service.settings
    files, valid_s = caller.service.stores.files, settings.storage_presign_s
    urls = await files.signed_urls("PUT", keys, valid_s) if settings.storage_presign else None
    if urls is None:
        raise ProblemError(
            "direct_upload_unavailable",
            "This service accepts files only itself.",
            hint="Use PUT …/files/{path}, or a resumable upload.",
        )
    return list(urls)


def _key(upload: Upload) -> str:
    return f"{upload.folder}/content"


@router.post(
    "/uploads/{upload_id}/complete",
    responses=declared(
        *("upload_incomplete", "state_conflict", "dataset_not_open", "digest_mismatch"),
        *("body_too_large", "too_many_files", "quota_exhausted", "storage_unavailable"),
    ),
)
async def complete_upload(upload_id: UploadId, caller: DatasetWriter) -> FileView:
    """Verifies size and SHA-256 of the bytes at the store, and adds them to the dataset as a file.

    If they differ (422), the bytes can be sent again. Repeating the request changes nothing.
    """
    upload = await caller.uploads.get(upload_id)
    path, sha256 = upload.path, upload.sha256
    if upload.kind != "signed" or path is None or sha256 is None:
        raise ProblemError("state_conflict", "This upload completes with its last byte.")
    if upload.state == "stored":
        return await caller.datasets.file(upload.dataset_id, path)
    await caller.datasets.get(upload.dataset_id)
    try:
        file, _ = await caller.datasets.add_copy(
            upload.dataset_id,
            path,
            _key(upload),
            size=upload.size,
            sha256=sha256,
            trusted=False,
            upload_id=upload_id,
        )
    except NotFound:
        raise ProblemError("upload_incomplete", "No bytes have arrived at the signed address.") from None
    await caller.uploads.conclude_signed(upload_id, caller.service.settings.storage_presign_s)
    return file


@router.post(
    "/datasets/{dataset_id}/fetches",
    status_code=202,
    responses=declared(
        *("address_refused", "dataset_not_open", "body_too_large"),
        *("too_many_files", "unsafe_path", "quota_exhausted"),
    ),
)
async def fetch_files(dataset_id: DatasetId, caller: DatasetWriter, body: NewFetches) -> UploadList:
    """Fetches files from their addresses: creates an upload for each, or none if one is refused.

    A file without a `path` is an archive, which is unpacked completely or not at all. `POST …/finalize` waits for all
    of them and reports errors. Addresses may be signed; they are not shown again.
    """
    files = [
        file if file.path is None else file.model_copy(update={"path": checked_path(file.path)})
        for file in body.files
    ]
    return UploadList(items=await caller.uploads.fetch(dataset_id, files))


@router.get("/datasets/{dataset_id}/fetches")
async def list_fetches(dataset_id: DatasetId, caller: ReadCaller) -> UploadList:
    """Fetched uploads that are unfinished, not in the dataset yet, or rejected; oldest first."""
    await caller.datasets.get(dataset_id)
    pending = await caller.uploads.of_dataset(dataset_id)
    return UploadList(items=tuple(upload for upload in pending if upload.host is not None))

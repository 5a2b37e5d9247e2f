"""Datasets: create, add files or an archive, finalize, list, delete."""

from __future__ import annotations

import base64
import binascii
import re
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import Response

from biresnerf.wire.datasets import (
    DatasetList,
    DatasetState,
    DatasetView,
    FileList,
    FileView,
    NewDataset,
    dataset_url,
)
from biresnerf.wire.safe_paths import checked_path
from service.http.access import DatasetWriter, ReadCaller
from service.http.dependencies import DatasetId, Paged, next_link, service_of
from service.http.problems import ProblemError, declared
from service.intake.archive_import import import_archive
from service.intake.dataset_finalize import begin_check, finish_check
from service.intake.json_body import JSON_BYTES_MAX, JsonRoute
from service.intake.uploads import limited_body, raw_request, write_stream
from workers.process.locked_folders import locked_folder

ENTRY_BYTES = 2048  # allowed in a manifest for each file that a dataset may have
_DIGEST = re.compile(r"sha-256=:([A-Za-z0-9+/=]+):")


class _ManifestRoute(JsonRoute):
    def bytes_max(self, request: Request) -> int:
        return JSON_BYTES_MAX + ENTRY_BYTES * service_of(request).settings.max_files


router = APIRouter(prefix="/v1/datasets", tags=["datasets"], route_class=_ManifestRoute)


@router.post(
    "",
    status_code=201,
    response_model=DatasetView,
    responses=declared("unsafe_path", "quota_exhausted"),
)
async def create_dataset(caller: DatasetWriter, body: NewDataset, response: Response) -> DatasetView:
    """Creates an empty dataset. With a manifest, `missing` in the response lists the files to send.

    Files that the tenant has sent before (same size and SHA-256) are copied and need not be sent.
    """
    for entry in body.manifest:
        checked_path(entry.path)
    dataset = await caller.datasets.create(body.name, body.manifest)
    if body.manifest:
        dataset = await caller.datasets.fill_known(dataset.id)
    response.headers["Location"] = dataset_url(dataset.id)
    return dataset


@router.get("")
async def list_datasets(
    caller: ReadCaller,
    paging: Paged,
    state: DatasetState | None = None,
    unused: Annotated[
        bool, Query(description="Only those that no job was made of, without rejected and expired ones.")
    ] = False,
) -> DatasetList:
    """Datasets, newest first."""
    page = await caller.datasets.list(state=state, unused=unused, limit=paging.limit, cursor=paging.cursor)
    return paging.respond(DatasetList, page)


@router.get("/{dataset_id}")
async def get_dataset(dataset_id: DatasetId, caller: ReadCaller) -> DatasetView:
    """The dataset, with the report of its check once it is finalized."""
    return await caller.datasets.get(dataset_id)


@router.delete("/{dataset_id}", status_code=204, responses=declared("dataset_in_use"))
async def delete_dataset(dataset_id: DatasetId, caller: DatasetWriter) -> None:
    """Deletes the dataset and its files. All its jobs must be deleted first."""
    await caller.datasets.delete(dataset_id)


@router.get("/{dataset_id}/files", responses=declared("expired"))
async def list_files(
    dataset_id: DatasetId,
    request: Request,
    response: Response,
    caller: ReadCaller,
    limit: Annotated[int, Query(ge=1, le=1000)] = 1000,
    cursor: Annotated[str | None, Query(max_length=2000)] = None,
) -> FileList:
    """The files received, by path."""
    page = await caller.datasets.files(dataset_id, limit=limit, cursor=cursor)
    response.headers.update(next_link(request, page.next_cursor))
    return FileList(items=page.items, next_cursor=page.next_cursor)


_UPLOAD_PROBLEMS = (
    *("body_timeout", "dataset_not_open", "body_too_large", "too_many_files"),
    *("unsafe_path", "storage_full", "quota_exhausted", "too_many_uploads"),
)


@router.put(
    "/{dataset_id}/files/{path:path}",
    status_code=201,
    response_model=FileView,
    responses=declared("malformed_body", "file_exists", "digest_mismatch", *_UPLOAD_PROBLEMS)
    | {204: {"description": "The file existed; its content was replaced."}},
    openapi_extra=raw_request("application/octet-stream"),
)
async def put_file(
    dataset_id: DatasetId,
    path: str,
    request: Request,
    caller: DatasetWriter,
    repr_digest: Annotated[str | None, Header(description="`sha-256=:BASE64:`")] = None,
    if_none_match: Annotated[str, Header(description="`*`: do not replace an existing file.")] = "",
) -> FileView | Response:
    """Uploads one file as raw bytes. Repeating the request changes nothing."""
    safe, sha256 = checked_path(path), _announced_digest(repr_digest)
    body = limited_body(request, caller.service.settings.max_file_bytes, caller.service.disk_budget)
    with caller.sending():
        file, new = await caller.datasets.add_file(
            dataset_id, safe, body, sha256=sha256, overwrite=if_none_match.strip() != "*"
        )
    return file if new else Response(status_code=204)


@router.delete(
    "/{dataset_id}/files/{path:path}", status_code=204, responses=declared("dataset_not_open", "unsafe_path")
)
async def delete_file(dataset_id: DatasetId, path: str, caller: DatasetWriter) -> None:
    """Deletes a file of an open dataset."""
    await caller.datasets.delete_file(dataset_id, checked_path(path))


def _announced_digest(header: str | None) -> str | None:
    if header is None:
        return None
    match = _DIGEST.search(header)
    try:
        digest = base64.b64decode(match[1], validate=True) if match else b""
    except binascii.Error:
        digest = b""
    if len(digest) != 32:
        raise ProblemError(
            "malformed_body",
            "The header holds no SHA-256.",
            where="Repr-Digest",
            hint="Send sha-256=:BASE64:.",
        )
    return digest.hex()


@router.post(
    "/{dataset_id}/archive",
    responses=declared(
        "archive_too_large", "archive_rejected", "name_collision", "validation_timeout", *_UPLOAD_PROBLEMS
    ),
    openapi_extra=raw_request("application/zip", "application/x-tar", "application/gzip"),
)
async def upload_archive(dataset_id: DatasetId, request: Request, caller: DatasetWriter) -> DatasetView:
    """Uploads all files of a zip, tar or tar.gz, sent as the raw body. A folder that wraps everything is dropped.

    If one entry is not acceptable, no file is added.
    """
    body = limited_body(request, caller.service.settings.max_archive_bytes, caller.service.disk_budget)
    await caller.datasets.get(dataset_id)
    with caller.sending():
        async with locked_folder(caller.service.staging_dir) as folder:
            await write_stream(body, folder / "archive")
            return await import_archive(caller.service, dataset_id, folder / "archive")


@router.post(
    "/{dataset_id}/finalize",
    responses=declared("dataset_not_complete", "dataset_invalid", "name_collision")
    | {202: {"model": DatasetView, "description": "In progress (with `Prefer: respond-async`)."}},
)
async def finalize_dataset(
    dataset_id: DatasetId,
    caller: DatasetWriter,
    response: Response,
    prefer: Annotated[str, Header(description="`respond-async`: respond at once.")] = "",
) -> DatasetView:
    """Freezes the files and checks them: poses, intrinsics, names, and every pixel.

    Responds when the check is done: 200 with a `ready` dataset, or 422 with what is wrong and how to fix it
    (the dataset is then `rejected` and accepts neither files nor jobs).
    """
    view = await begin_check(caller, dataset_id)
    if "respond-async" not in prefer.lower() or view.state != "finalizing":
        return await finish_check(caller, dataset_id)
    response.status_code = 202
    response.headers.update({"Location": dataset_url(dataset_id), "Retry-After": "2"})
    response.headers["Preference-Applied"] = "respond-async"
    return view

"""Adds uploaded archives and files to a dataset."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import uuid
from functools import partial
from pathlib import Path

from biresnerf.errors import FaultError
from biresnerf.wire.datasets import DatasetView
from biresnerf.wire.problems import JobError
from service.http.dependencies import Service
from service.http.problems import ProblemError, problem_of
from service.intake.sandboxed_child import Limits, run_confined
from service.intake.unpack import UnpackRequest
from service.intake.uploads import capped, write_stream
from workers.database.claimed_work import lease_renewed
from workers.process.locked_folders import locked_folder
from workers.process.waiting import retry_while_unavailable
from workers.records import Upload
from workers.settings.errors import EngineError, NotFound
from workers.store.measured_stream import MeasuredStream

logger = logging.getLogger(__name__)

RATIO_MAX = 200.0
# Poll intervals: of an upload that another process stores, and of those that are being fetched.
_POLL_S, _FETCH_POLL_S = 0.3, 1.0
# A folder of this name is part of the dataset, even if it is the only one in the archive.
_KEPT_FOLDERS = {"images"}


async def import_archive(
    service: Service, dataset_id: str, archive: Path, upload_id: str | None = None
) -> DatasetView:
    """Unpacks ``archive``, alone in its staging folder, in a child process; then stores all files, or none.

    ``upload_id``: the upload that brought the archive. Finalizing the dataset waits for the import.

    Raises:
        ProblemError: the archive's fault; names the entry.
    """
    datasets = service.stores.datasets
    async with datasets.importing(dataset_id):
        root = await _unpacked(service, dataset_id, archive, upload_id)
        found = await asyncio.to_thread(_files_below, root)
        files = {path.relative_to(root).as_posix(): path for path in found}
        await datasets.add_files(dataset_id, files, upload_id=upload_id)
    return await datasets.get(dataset_id)


async def _unpacked(service: Service, dataset_id: str, archive: Path, upload_id: str | None) -> Path:
    """The folder with the archive's content."""
    settings = service.settings
    dataset = await service.stores.datasets.get(dataset_id)
    if dataset.state != "open":
        raise ProblemError(
            "dataset_not_open", f"The dataset is {dataset.state}.", hint="Create a new dataset."
        )
    allowed = min(settings.max_unpacked_bytes, settings.max_dataset_bytes - dataset.bytes)
    # Half: files are unpacked here and then stored, possibly on the same disk.
    room = await asyncio.to_thread(service.disk_budget.free_bytes) // 2
    into = archive.parent / "content"
    into.mkdir()
    request = UnpackRequest(
        archive=archive,
        into=into,
        files_max=settings.max_files - dataset.files,
        bytes_max=min(allowed, room),
        all_room=room < allowed,
        file_bytes_max=settings.max_file_bytes,
        ratio_max=RATIO_MAX,
    )
    limits = Limits(
        seconds=settings.check_timeout_s,
        memory_bytes=service.memory.unpack,
        file_bytes=settings.max_file_bytes + 2**20,
    )
    async with service.unpacking.turn(dataset.tenant), service.stores.uploads.unpacking(upload_id):
        await run_confined("service.intake.unpack", request, limits)
    return await asyncio.to_thread(content_root, into)


def content_root(folder: Path) -> Path:
    """The folder that holds the data: single folders that merely wrap everything are passed through."""
    while True:
        children = list(folder.iterdir())
        if len(children) != 1 or not children[0].is_dir() or children[0].name.lower() in _KEPT_FOLDERS:
            return folder
        folder = children[0]


def _files_below(root: Path) -> list[Path]:
    return sorted(path for path in root.rglob("*") if path.is_file())


def start_import(service: Service, upload_id: str) -> None:
    """Adds a received upload to its dataset, in the background."""

    async def start() -> None:
        try:
            await import_upload(service, upload_id)
        except (ProblemError, EngineError, OSError) as error:
            logger.warning("upload %s is received but not stored yet: %s", upload_id, error)

    service.keep_running(start(), name=f"import {upload_id}")


async def import_upload(service: Service, upload_id: str) -> None:
    """Adds a received upload to its dataset unless another process does so; its state holds the outcome.

    Errors of the service (storage unavailable, disk full) are raised; the upload stays received and is retried.
    """
    uploads, token = service.stores.uploads, uuid.uuid4()
    if not await retry_while_unavailable(lambda: uploads.take(upload_id, token)):
        return
    failure: JobError | None = None
    try:
        async with lease_renewed(partial(uploads.take, upload_id, token), 2 * service.settings.beat_s):
            await _add_to_dataset(service, await uploads.get(upload_id))
    except NotFound:
        return  # deleted meanwhile
    except BaseException as error:
        failure = _client_error(error) if isinstance(error, FaultError) else None
        if failure is None:
            # If this process is only stopping, another takes the upload at once.
            await uploads.give_back(upload_id, token, failed=isinstance(error, Exception))
            raise
    await retry_while_unavailable(lambda: uploads.conclude(upload_id, token, failure))


def _client_error(error: FaultError) -> JobError | None:
    """The upload's error if sending it again would fail again; None if the service is at fault."""
    problem = problem_of(error)
    service_at_fault = problem.status >= 500 or (problem.retryable and problem.code != "quota_exhausted")
    return None if service_at_fault else JobError(**dict(problem.fault))


async def _add_to_dataset(service: Service, upload: Upload) -> None:
    uploads, datasets = service.stores.uploads, service.stores.datasets
    if upload.path is not None:
        content = uploads.content(upload)
        await datasets.add_file(
            upload.dataset_id, upload.path, content, sha256=upload.sha256, upload_id=upload.id
        )
        return
    async with locked_folder(service.staging_dir) as folder:
        archive = folder / "archive"
        content = MeasuredStream("archive", uploads.content(upload), upload.size, upload.sha256).all_with(b"")
        await write_stream(capped(content, upload.size, budget=service.disk_budget), archive)
        await import_archive(service, upload.dataset_id, archive, upload.id)


async def import_received(service: Service, dataset_id: str) -> None:
    """Waits until all uploads are in the dataset: those received by other requests and those being fetched.

    Raises:
        ProblemError: ``dataset_not_complete`` if an upload is unfinished; the error of one that failed.
    """
    while True:
        pending = await service.stores.uploads.of_dataset(dataset_id)
        received = [upload for upload in pending if upload.state == "received"]
        failed = any(upload.error for upload in pending)
        fetched = any(upload.host is not None and upload.state == "receiving" for upload in pending)
        busy = bool(received) or await service.stores.datasets.being_imported(dataset_id)
        if not busy and (failed or not fetched):
            break
        for upload in received:
            await import_upload(service, upload.id)
        await asyncio.sleep(_POLL_S if busy else _FETCH_POLL_S)
    for upload in sorted(pending, key=lambda upload: upload.error is None):
        give_up = f"or give it up: DELETE /v1/uploads/{upload.id}"
        if upload.error is not None:
            raise ProblemError.of(upload.error, hint=f"{upload.error.hint} Send it again, {give_up}.".strip())
        raise ProblemError(
            "dataset_not_complete",
            f"Of the upload {upload.id}, {upload.received} of {upload.size} bytes have arrived.",
            hint=f"Send the rest, {give_up}.",
        )


def file_sha256(path: Path) -> str:
    """The file's SHA-256, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

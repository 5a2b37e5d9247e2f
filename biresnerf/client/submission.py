"""Submits a set as a job: a local folder (manifest, missing files), or addresses of files; check, queue."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Unpack

from anyio import to_thread

from biresnerf.client.dataset_calls import DatasetCalls
from biresnerf.client.errors import ServiceError
from biresnerf.client.job_calls import (
    JobCalls,
    OptionsLike,
    as_options,
    idempotency_key_of,
    with_name,
)
from biresnerf.client.scene import look_at
from biresnerf.client.transport import looks, tell
from biresnerf.client.uploads import LocalFile, Uploads
from biresnerf.wire.datasets import DatasetView, FileAddress
from biresnerf.wire.jobs import JobDetails, JobView, NewJob


@dataclass(frozen=True)
class Sending:
    """The progress of a submission. An interrupted one is resumed by its ``dataset_id``."""

    step: Literal["reading", "sending", "fetching", "checking", "queueing"]
    files: int = 0
    files_missing: int = 0
    bytes_missing: int = 0
    bytes_sent: int = 0
    dataset_id: str | None = None


class Submissions(DatasetCalls, JobCalls, Uploads):
    """Submits local folders, and files at addresses."""

    async def submit(
        self,
        source: Path | Sequence[FileAddress],
        options: OptionsLike = None,
        *,
        name: str | None = None,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
        resume: str | None = None,
        on_progress: Callable[[Sending], object] = lambda _: None,
        **details: Unpack[JobDetails],
    ) -> JobView:
        """Sends the missing files of a set, or has all of them fetched, has them checked, and queues a job.

        If the service refuses the files, the dataset is deleted there. If the connection fails or the caller stops,
        it stays: the same submission with ``resume`` sends the rest, or returns the job if it is queued already.
        Fetches by the service continue without the caller.

        Args:
            source: a folder (or file with poses), or addresses of files that the service fetches itself; see
                `bucket_files` for those of a bucket.
            name: of the dataset, and of the job unless ``labels`` has a ``name``. Default: the folder's.
            resume: the dataset of an interrupted submission; addresses are not needed for it any more.
            on_progress: called at each step, and with the bytes sent.
            details: see `JobDetails`.

        Raises:
            InputError: the folder or the options cannot be used; nothing was sent then.
            ServiceError: the service refuses, or cannot be reached; also where an address leads to no file, or to
                another one than was announced.
        """
        body = NewJob(dataset_id="", options=as_options(options), labels=dict(labels or {}), **details)
        ready = await self.send(source, body.options, name=name, resume=resume, on_progress=on_progress)
        return await self._queued(ready, body, idempotency_key, resume is None, on_progress)

    async def send(
        self,
        source: Path | Sequence[FileAddress],
        options: OptionsLike = None,
        *,
        name: str | None = None,
        resume: str | None = None,
        on_progress: Callable[[Sending], object] = lambda _: None,
    ) -> DatasetView:
        """What `submit` does before it queues a job; ``options`` say which frames of a video are sent."""
        files: list[LocalFile] = []
        if isinstance(source, Path):
            await tell(on_progress, Sending("reading"))
            files = await _local_files(source, as_options(options).video_frames)
            folder = source.resolve()
            name = name or (folder.parent if folder.is_file() else folder).name
        if resume is None:
            target = await self.create_dataset((name or "scene")[:200], [file.entry for file in files])
        else:
            target = await self.dataset(resume)
        if target.state == "ready":  # the submission was interrupted after its check
            return target
        async with self._discarding(target, resume is None):
            if isinstance(source, Path):
                return await self._fill(target, files, on_progress)
            return await self._fetch(target, source if resume is None else (), on_progress)

    async def _queued(
        self,
        ready: DatasetView,
        body: NewJob,
        idempotency_key: str | None,
        fresh: bool,
        on_progress: Callable[[Sending], object],
    ) -> JobView:
        labels = with_name(body.labels, ready.name)
        body = body.model_copy(update={"dataset_id": ready.id, "labels": labels})
        await tell(on_progress, Sending("queueing", ready.files, dataset_id=ready.id))
        async with self._discarding(ready, fresh):
            return await self._queue("/v1/jobs", body, idempotency_key or idempotency_key_of(body))

    @asynccontextmanager
    async def _discarding(self, target: DatasetView, fresh: bool) -> AsyncIterator[None]:
        """Deletes a fresh dataset where what is done with it is refused."""
        try:
            yield
        except ServiceError as error:
            if error.users_fault and fresh:
                await self._discard(target, error)
            raise

    async def _fetch(
        self, target: DatasetView, files: Sequence[FileAddress], on_progress: Callable[[Sending], object]
    ) -> DatasetView:
        """Has the files fetched and the dataset checked."""
        if files:
            await self.fetch_files(target.id, files)
        state = Sending("fetching", len(files), dataset_id=target.id)
        async for _ in looks():
            pending = await self.fetches(target.id)
            if not pending:
                break
            rejected = next((each.error for each in pending if each.error is not None), None)
            if rejected is not None:
                raise ServiceError.of(rejected, status=422)
            total = max(state.bytes_missing, sum(each.size for each in pending))
            state = replace(
                state,
                files=max(state.files, len(pending)),
                files_missing=len(pending),
                bytes_missing=total,
                bytes_sent=total - sum(each.size - each.received for each in pending),
            )
            await tell(on_progress, state)
        await tell(on_progress, replace(state, step="checking"))
        return await self.finalize(target.id)

    async def _fill(
        self, target: DatasetView, files: list[LocalFile], on_progress: Callable[[Sending], object]
    ) -> DatasetView:
        """Sends the missing files and has the dataset checked."""
        missing = set(target.missing)
        sizes = [file.size for file in files if file.name in missing]
        state = Sending("sending", len(files), len(sizes), sum(sizes), dataset_id=target.id)
        await tell(on_progress, state)

        async def count(more: int) -> None:
            nonlocal state
            state = replace(state, bytes_sent=state.bytes_sent + more)
            await tell(on_progress, state)

        await self.send_missing(target, files, count)
        await tell(on_progress, replace(state, step="checking", bytes_sent=state.bytes_missing))
        return await self.finalize(target.id)

    async def _discard(self, target: DatasetView, cause: ServiceError) -> None:
        try:
            await self.delete_dataset(target.id)
        except ServiceError as error:
            cause.add_note(f"The dataset {target.id} remains on the service: {error}")


async def _local_files(path: Path, video_frames: int) -> list[LocalFile]:
    """The files of the input at ``path``, with their digests; raises `InputError`."""
    found = await to_thread.run_sync(look_at, path, video_frames, abandon_on_cancel=True)
    return [
        await to_thread.run_sync(LocalFile.at, name, file, abandon_on_cancel=True) for name, file in found
    ]

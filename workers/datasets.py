"""The dataset record: create, fill with files, check, list, delete. Used by the service; never loads torch."""

from __future__ import annotations

from collections.abc import AsyncIterable, Sequence

from workers.records import DatasetFile, DatasetRecord, DatasetState, ManifestEntry, Page


class DatasetStore:
    """Datasets in the database and the file store. Get one from `workers.stores.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) where the database does not answer.
    """

    async def create(self, name: str, manifest: Sequence[ManifestEntry] = ()) -> DatasetRecord:
        """An empty dataset in state ``open``."""
        raise NotImplementedError

    async def get(self, dataset_id: str) -> DatasetRecord:
        """The dataset; raises `NotFound`."""
        raise NotImplementedError

    async def list(
        self, *, state: DatasetState | None = None, limit: int = 50, cursor: str | None = None
    ) -> Page[DatasetRecord]:
        """Datasets, newest first; raises `InputError` (``bad_cursor``)."""
        raise NotImplementedError

    async def add_file(
        self,
        dataset_id: str,
        path: str,
        chunks: AsyncIterable[bytes],
        *,
        sha256: str | None = None,
        overwrite: bool = True,
    ) -> tuple[DatasetFile, bool]:
        """Store one file under its relative path; returns it and whether the path is new.

        Raises `NotFound`, `Conflict` (``dataset_not_open``, ``file_exists``), `LimitReached`
        (``body_too_large``, ``too_many_files``), `InputError` (``unsafe_path``, ``digest_mismatch``).
        Where it raises, the dataset is as before.
        """
        raise NotImplementedError

    async def file(self, dataset_id: str, path: str) -> DatasetFile:
        """One file; raises `NotFound`."""
        raise NotImplementedError

    async def files(
        self, dataset_id: str, *, limit: int = 1000, cursor: str | None = None
    ) -> Page[DatasetFile]:
        """The files, by path; raises `NotFound`, `InputError` (``bad_cursor``)."""
        raise NotImplementedError

    async def finalize(self, dataset_id: str) -> DatasetRecord:
        """Freeze the content: ``open`` becomes ``finalizing`` (other states come back as they are).

        Raises `NotFound`, `Conflict` (``dataset_not_complete``: manifest files lack, or no file at all).
        Then call `check` (in a background task, or awaited), which leads to ``ready`` or ``rejected``.
        """
        raise NotImplementedError

    async def check(self, dataset_id: str) -> DatasetRecord:
        """Validate a ``finalizing`` dataset in a child process and write the outcome; idempotent.

        Only one check of a dataset runs at a time, over all processes. Other states come back as they are.
        """
        raise NotImplementedError

    async def unfinished(self) -> tuple[str, ...]:
        """Ids left in ``finalizing`` (by a process that died): `check` them at start."""
        raise NotImplementedError

    async def delete(self, dataset_id: str) -> None:
        """Delete a dataset with its files; raises `NotFound`, `Conflict` (``dataset_in_use`` by an unfinished job)."""
        raise NotImplementedError

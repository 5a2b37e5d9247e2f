"""Dataset records: create, add files, check, list, delete. For the service; never loads torch."""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from psycopg.types.json import Jsonb

from biresnerf.errors import InputError
from biresnerf.wire.base import Page
from biresnerf.wire.datasets import DatasetState, DatasetView, ManifestEntry
from workers.database.claimed_work import lease_renewed
from workers.database.database import Connection, Database, OwnedStore
from workers.database.ids import cursor_place, new_id
from workers.datasets.dataset_check import Checker
from workers.datasets.dataset_rows import (
    DATASET,
    KNOWN,
    MINE,
    UNUSED,
    file_key,
    lock_dataset,
    record_files,
    require_open,
    require_places,
)
from workers.jobs.job_rows import jobs_of_dataset
from workers.jobs.quotas import require_byte_quota
from workers.process.waiting import retry_while_unavailable
from workers.records import NEWEST_FIRST, DatasetFile, newest_first, page_of, record_from_row, shown_key
from workers.settings.errors import Conflict, Expired, LimitReached, NotFound, Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore, StoredFile
from workers.store.trash import delete_unless_rescued, discard, rescue
from workers.tenants.tenants import LOCAL_TENANT

COPIES_AT_ONCE = 8
# Stores a file under a key, up to a number of bytes.
_Store: TypeAlias = Callable[[str, int], Awaitable[StoredFile]]
FILE = "SELECT path, key, size, sha256, created_at FROM dataset_files"


class DatasetStore(OwnedStore):
    """Datasets in the database and the file store. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) if the database does not answer.
    """

    def __init__(self, database: Database, files: FileStore, settings: Settings) -> None:
        super().__init__(database)
        self._files, self._settings = files, settings
        self._checker = Checker(database, files, settings)

    async def create(self, name: str, manifest: Sequence[ManifestEntry] = ()) -> DatasetView:
        """An empty dataset in state ``open``; raises `LimitReached` (``too_many_files``)."""
        if len(manifest) > self._settings.max_files:
            raise LimitReached(
                "too_many_files", f"The manifest has more than {self._settings.max_files} files."
            )
        dataset_id = new_id("ds")
        async with self._database.transaction() as connection:
            await connection.execute(
                "INSERT INTO datasets (id, tenant, name, manifest) VALUES (%s, %s, %s, %s)",
                (
                    *(dataset_id, self._tenant or LOCAL_TENANT, name),
                    Jsonb([entry.model_dump() for entry in manifest]),
                ),
            )
            return await self._required(connection, dataset_id)

    async def get(self, dataset_id: str) -> DatasetView:
        """The dataset; raises `NotFound`."""
        async with self._database.transaction() as connection:
            return await self._required(connection, dataset_id)

    async def list(
        self,
        *,
        state: DatasetState | None = None,
        unused: bool = False,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[DatasetView]:
        """Datasets, newest first; ``unused`` ones wait for their first job. Raises `InputError` (``bad_cursor``)."""
        rows = await self._database.fetch(
            DATASET
            + f" WHERE {MINE} AND (%s::text IS NULL OR state = %s) AND (NOT %s OR {UNUSED})"
            + NEWEST_FIRST,
            *(self._tenant, state, state, unused, *newest_first(cursor, limit)),
        )
        return page_of((record_from_row(DatasetView, row) for row in rows), limit)

    async def add_file(
        self,
        dataset_id: str,
        path: str,
        chunks: AsyncIterable[bytes],
        *,
        sha256: str | None = None,
        overwrite: bool = True,
        upload_id: str | None = None,
    ) -> tuple[DatasetFile, bool]:
        """Store one file under its relative path; returns it and whether the path is new.

        ``upload_id``: the upload that brought the bytes, whose size the tenant's quota has counted already.
        Raises `NotFound`, `Conflict` (``dataset_not_open``, ``file_exists``), `LimitReached`
        (``body_too_large``, ``too_many_files``), `InputError` (``unsafe_path``, ``digest_mismatch``).
        If it raises, the dataset is unchanged.
        """

        async def stored(key: str, room: int) -> StoredFile:
            return await self._files.put(key, chunks, limit_bytes=room, expected_sha256=sha256)

        return await self._add_one(dataset_id, path, stored, upload_id, overwrite=overwrite)

    async def add_files(
        self, dataset_id: str, files: Mapping[str, Path], *, upload_id: str | None = None
    ) -> None:
        """Store local files under their relative paths: all, or none if one fails.

        Raises as `add_file` does. Existing files are replaced.
        """
        # Stores each file, given its key and the room that is left.
        storing = {
            path: (lambda key, room, file=file: self._files.put_path(key, file, limit_bytes=room))
            for path, file in files.items()
        }
        await self._add(dataset_id, storing, upload_id, overwrite=True)

    @contextlib.asynccontextmanager
    async def importing(self, dataset_id: str) -> AsyncIterator[None]:
        """Within the context, `being_imported` is true in all processes."""
        token = uuid.uuid4()

        async def sign_of_life() -> bool:
            await self._database.fetch(
                "INSERT INTO dataset_imports (token, dataset_id, live_until)"
                " SELECT %s, id, clock_timestamp() + make_interval(secs => %s) FROM datasets WHERE id = %s"
                " ON CONFLICT (token) DO UPDATE SET live_until = excluded.live_until",
                *(token, 2 * self._settings.beat_s, dataset_id),
            )
            return True

        await sign_of_life()
        try:
            async with lease_renewed(sign_of_life, 2 * self._settings.beat_s):
                yield
        finally:
            with contextlib.suppress(Unavailable):  # then it expires
                await self._database.fetch("DELETE FROM dataset_imports WHERE token = %s", token)

    async def being_imported(self, dataset_id: str) -> bool:
        """Whether an archive is being brought into the dataset."""
        sql = "SELECT 1 FROM dataset_imports WHERE dataset_id = %s AND live_until > clock_timestamp() LIMIT 1"
        return bool(await self._database.fetch(sql, dataset_id))

    async def add_copy(
        self,
        dataset_id: str,
        path: str,
        source: str,
        *,
        size: int,
        sha256: str,
        trusted: bool,
        upload_id: str | None = None,
    ) -> tuple[DatasetFile, bool]:
        """Like `add_file`, from a key of the store, to which others may write unless it is ``trusted``.

        Raises `NotFound` also where there is no ``source``.
        """

        async def copied(key: str, room: int) -> StoredFile:
            if size > room:
                raise LimitReached("body_too_large", f"{path} has more than the {room} bytes left for it.")
            file = await self._files.copy(source, key)
            # Hash the copy, which no other process can write to: the source may change meanwhile.
            found = sha256 if trusted else await self._files.sha256(key)
            if (file.size, found) != (size, sha256):
                raise InputError(
                    "digest_mismatch",
                    f"What arrived has {file.size} bytes and SHA-256 {found}, not {size} and {sha256}.",
                    where=path,
                    hint="Send the file again.",
                )
            return file.model_copy(update={"sha256": found})

        return await self._add_one(dataset_id, path, copied, upload_id, overwrite=True)

    async def fill_known(self, dataset_id: str) -> DatasetView:
        """Copy files of the manifest that the same tenant has sent before; returns the dataset.

        Compares digest and size within one tenant, so no tenant learns what others have sent. Raises `NotFound`,
        `LimitReached`.
        """
        known = await self._database.fetch(KNOWN, dataset_id, self._tenant)
        turns = asyncio.Semaphore(COPIES_AT_ONCE)

        async def copy_one(row: dict[str, Any]) -> None:
            async with turns:
                with contextlib.suppress(NotFound):  # deleted just now: the client has to send it
                    await self.add_copy(
                        *(dataset_id, row["path"], row["key"]),
                        **{"size": row["size"], "sha256": row["sha256"], "trusted": True},
                    )

        copies = [asyncio.create_task(copy_one(row)) for row in known]
        try:
            await asyncio.gather(*copies)
        finally:
            for copying in copies:
                copying.cancel()
        return await self.get(dataset_id)

    async def _add_one(
        self, dataset_id: str, path: str, store: _Store, upload_id: str | None, *, overwrite: bool
    ) -> tuple[DatasetFile, bool]:
        (file,), replaced = await self._add(dataset_id, {path: store}, upload_id, overwrite=overwrite)
        return file, not replaced

    async def _add(
        self, dataset_id: str, storing: Mapping[str, _Store], upload_id: str | None, *, overwrite: bool
    ) -> tuple[Sequence[DatasetFile], int]:
        """Adds the files; returns them, and how many replaced another."""
        # Each upload has its own folder: one that fails or comes too late never touches an older file.
        folder = f"datasets/{dataset_id}/files/{new_id('v')}"
        # And each file has its own: that of a replaced file goes to the trash.
        keys = {path: file_key(f"{folder}/{number}", path) for number, path in enumerate(storing)}
        paths, stored = list(storing), {}
        async with self._database.transaction() as connection:
            await require_open(connection, dataset_id, self._tenant)
            there = await require_places(
                connection, self._settings, dataset_id, paths, 0, overwrite=overwrite
            )
            await require_byte_quota(connection, dataset_id, 1 if upload_id is None else 0)
            # Trash until the files are recorded: this process may be killed before that.
            await discard(connection, folder, after_s=self._settings.upload_expiry_s)
        room = min(self._settings.max_file_bytes, self._settings.max_dataset_bytes - there)
        try:
            for path, store in storing.items():
                stored[path] = await store(keys[path], room)
            total = sum(file.size for file in stored.values())
            async with self._database.transaction() as connection:
                await require_open(connection, dataset_id, self._tenant)
                await require_places(
                    connection, self._settings, dataset_id, paths, total, overwrite=overwrite
                )
                await rescue(connection, folder)
                recorded = await record_files(connection, dataset_id, stored, upload_id)
                # Everything is counted now, including replaced files and the rest of the upload.
                await require_byte_quota(connection, dataset_id, 0)
                return recorded
        except BaseException:
            # They may have been recorded, with only the acknowledgement lost.
            await delete_unless_rescued(self._database, self._files, folder)
            raise

    async def file(self, dataset_id: str, path: str) -> DatasetFile:
        """One file; raises `NotFound`."""
        missing = f"Dataset {dataset_id} has no file {path}."
        sql = (
            FILE + " WHERE dataset_id = %s AND path = %s"
            f" AND EXISTS (SELECT 1 FROM datasets WHERE id = dataset_files.dataset_id AND {MINE})"
        )
        async with self._database.transaction() as connection:
            row = await connection.required_row(missing, sql, dataset_id, path, self._tenant)
        return DatasetFile.model_validate(row)

    async def delete_file(self, dataset_id: str, path: str) -> None:
        """Delete a file of an open dataset; raises `NotFound`, `Conflict` (``dataset_not_open``)."""
        async with self._database.transaction() as connection:
            await require_open(connection, dataset_id, self._tenant)
            row = await connection.required_row(
                f"Dataset {dataset_id} has no file {path}.",
                "DELETE FROM dataset_files WHERE dataset_id = %s AND path = %s RETURNING key",
                *(dataset_id, path),
            )
            await discard(connection, row["key"].removesuffix(f"/{path}"))
            await connection.execute(
                "UPDATE datasets SET revision = revision + 1 WHERE id = %s", (dataset_id,)
            )

    async def files(
        self, dataset_id: str, *, limit: int = 1000, cursor: str | None = None
    ) -> Page[DatasetFile]:
        """The files, by path; raises `NotFound`, `Expired`, `InputError` (``bad_cursor``)."""
        after = cursor_place(cursor, 1)[0] if cursor else ""
        async with self._database.transaction() as connection:
            if (await self._required(connection, dataset_id)).state == "expired":
                raise Expired(f"The files of dataset {dataset_id} were not used for long and are gone.")
            sql = FILE + " WHERE dataset_id = %s AND path > %s ORDER BY path LIMIT %s"
            rows = await connection.rows(sql, dataset_id, after, limit + 1)
        return page_of(map(DatasetFile.model_validate, rows), limit, ("path",))

    async def shown(self, dataset_id: str, name: str) -> bytes:
        """A file that pages show of a checked dataset; raises `NotFound`, `Expired`."""
        if (await self.get(dataset_id)).state == "expired":
            raise Expired(f"The files of dataset {dataset_id} were not used for long and are gone.")
        key = f"{shown_key(dataset_id)}/{name}"
        try:
            return b"".join([chunk async for chunk in self._files.read(key)])
        except NotFound:
            raise NotFound(
                f"Dataset {dataset_id} has no pictures: they are made when it is checked."
            ) from None

    async def finalize(self, dataset_id: str) -> DatasetView:
        """Freeze the content: ``open`` becomes ``finalizing`` (other states are returned unchanged).

        Raises `NotFound`, `Conflict` (``dataset_not_complete``: files of the manifest are missing, or there are none).
        Then call `check` (in a background task, or awaited), which leads to ``ready`` or ``rejected``.
        """
        async with self._database.transaction() as connection:
            await lock_dataset(connection, dataset_id, self._tenant)
            dataset = await self._required(connection, dataset_id)
            if dataset.state != "open":
                return dataset
            if dataset.missing or not dataset.files:
                lacking = ", ".join(dataset.missing[:5]) or "files"
                raise Conflict("dataset_not_complete", f"Dataset {dataset_id} still lacks {lacking}.")
            await connection.execute(
                "UPDATE datasets SET state = 'finalizing', revision = revision + 1 WHERE id = %s",
                (dataset_id,),
            )
            return await self._required(connection, dataset_id)

    async def check(self, dataset_id: str) -> DatasetView:
        """Validate a ``finalizing`` dataset in a child process and record the outcome; idempotent.

        Only one check of a dataset runs at a time, over all processes; other callers wait for its outcome. Datasets in
        other states are returned unchanged. Raises `NotFound`.
        """
        await self._checker.check(dataset_id)
        return await retry_while_unavailable(lambda: self.get(dataset_id))

    async def unfinished(self) -> tuple[str, ...]:
        """Ids of ``finalizing`` datasets that no process is checking: it died, or checks others first."""
        return await self._checker.unfinished()

    async def delete(self, dataset_id: str) -> None:
        """Delete a dataset with its files; raises `NotFound`, `Conflict` (``dataset_in_use`` by jobs)."""
        async with self._database.transaction() as connection:
            await lock_dataset(connection, dataset_id, self._tenant)
            await self._required(connection, dataset_id)
            users = await jobs_of_dataset(connection, dataset_id)
            if users:
                raise Conflict(
                    "dataset_in_use", f"Delete first the jobs of {dataset_id}: {', '.join(users[:5])}."
                )
            await connection.execute("DELETE FROM datasets WHERE id = %s", (dataset_id,))
            await discard(connection, f"datasets/{dataset_id}")

    async def _required(self, connection: Connection, dataset_id: str) -> DatasetView:
        sql = DATASET + f" WHERE datasets.id = %s AND {MINE}"
        row = await connection.required_row(f"No dataset {dataset_id}.", sql, dataset_id, self._tenant)
        return record_from_row(DatasetView, row)

"""Where files lie: a thin layer over obstore, so that callers see keys, sizes, digests and byte streams.

Layout: ``datasets/{id}/files/{path}``, ``jobs/{id}/checkpoints/{attempt}-{token}-{n}/…``,
``jobs/{id}/results/{attempt}-{token}/…``, ``jobs/{id}/logs/{attempt}-{token}.txt``.
"""

from __future__ import annotations

import asyncio
import hashlib
import shutil
from collections.abc import AsyncIterable, AsyncIterator, Iterable
from datetime import datetime
from pathlib import Path, PurePosixPath

import obstore
from obstore.store import LocalStore

from biresnerf.errors import InputError
from workers.errors import LimitReached, NotFound, SetupError, Unavailable
from workers.records import Record

CHUNK_BYTES = 2**20
PART_BYTES = 8 * 2**20


class StoredFile(Record):
    """A file in the store; ``sha256`` is known only to who wrote it."""

    key: str
    size: int
    etag: str
    modified_at: datetime
    sha256: str | None = None


class FileStore:
    """Files by key. Writes are atomic: a reader sees the old file, the new one or none, never a part.

    Keys are relative paths with ``/``; a key with an empty, ``.`` or ``..`` part is refused (`ValueError`).
    """

    def __init__(self, root: Path) -> None:
        """Open (and create) a store under the local folder ``root``; raises `SetupError` if it cannot."""
        self.root = root.resolve()
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            self._store = LocalStore(str(self.root))
        except OSError as error:
            raise SetupError(
                "storage_unusable",
                f"Cannot use {root}: {error}. Set BIRESNERF_DATA_DIR to a writable folder.",
            ) from error

    async def put(
        self, key: str, chunks: AsyncIterable[bytes], *, limit_bytes: int, expected_sha256: str | None = None
    ) -> StoredFile:
        """Store a byte stream of at most ``limit_bytes``, hashing it on the way.

        Raises `LimitReached` (``body_too_large``) at the first byte too many, `InputError`
        (``digest_mismatch``) at the end; then nothing is stored, and what was there before stays.
        """
        digest, size = hashlib.sha256(), 0

        async def measured() -> AsyncIterator[bytes]:
            nonlocal size
            async for chunk in chunks:
                size += len(chunk)
                if size > limit_bytes:
                    raise LimitReached("body_too_large", f"{key} has more than {limit_bytes} bytes.")
                digest.update(chunk)
                yield chunk
            if expected_sha256 is not None and digest.hexdigest() != expected_sha256:
                raise InputError(
                    "digest_mismatch",
                    f"What arrived has SHA-256 {digest.hexdigest()}, announced was {expected_sha256}.",
                    where=key.rpartition("/")[2],
                    mend="Send the file again.",
                )

        try:
            await obstore.put_async(self._store, _checked(key), measured(), chunk_size=PART_BYTES)
        except obstore.exceptions.BaseError as error:
            raise Unavailable("storage_unavailable", f"Cannot store {key}: {error}") from error
        return (await self.head(key)).model_copy(update={"sha256": digest.hexdigest()})

    async def put_path(self, key: str, path: Path) -> StoredFile:
        """Store a local file. The file is opened once, so a writer that renames over it does not disturb."""
        with path.open("rb") as file:

            async def chunks() -> AsyncIterator[bytes]:
                while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
                    yield chunk

            return await self.put(key, chunks(), limit_bytes=2**62)

    async def head(self, key: str) -> StoredFile:
        """Size, ETag and time of a file; raises `NotFound`."""
        try:
            meta = await obstore.head_async(self._store, _checked(key))
        except FileNotFoundError:
            raise NotFound(f"No file {key}.") from None
        return StoredFile(
            key=key,
            size=meta["size"],
            etag=(meta["e_tag"] or "").strip('"'),
            modified_at=meta["last_modified"],
        )

    async def read(self, key: str, start: int = 0, end: int | None = None) -> AsyncIterator[bytes]:
        """The bytes ``[start, end)`` of a file, in chunks; ``end`` none is the file's end.

        Raises `NotFound` when the first chunk is asked for; call `head` before answering a client.
        """
        info = await self.head(key)
        stop = info.size if end is None else min(end, info.size)
        if start >= stop:
            return
        try:
            result = await obstore.get_async(self._store, key, options={"range": (start, stop)})
        except FileNotFoundError:
            raise NotFound(f"No file {key}.") from None
        async for chunk in result.stream(min_chunk_size=CHUNK_BYTES):
            yield bytes(chunk)

    async def list(self, prefix: str) -> list[StoredFile]:
        """All files whose key starts with the folder ``prefix``, sorted by key."""
        found: list[StoredFile] = []
        async for batch in obstore.list(self._store, prefix=_checked(prefix.rstrip("/"))):
            found += [
                StoredFile(
                    key=meta["path"],
                    size=meta["size"],
                    etag=(meta["e_tag"] or "").strip('"'),
                    modified_at=meta["last_modified"],
                )
                for meta in batch
            ]
        return sorted(found, key=lambda file: file.key)

    async def delete(self, key: str) -> None:
        """Delete a file; one that is not there is no error."""
        try:
            await obstore.delete_async(self._store, _checked(key))
        except FileNotFoundError:
            return

    async def delete_prefix(self, prefix: str, *, keep: str | None = None) -> None:
        """Delete all under the folder ``prefix``, except the sub-folder named ``keep``."""
        folder = self.root / _checked(prefix.rstrip("/"))

        def remove() -> None:
            # By folders, not by listing: this also takes what an upload that was killed left half-written.
            for child in folder.iterdir() if folder.is_dir() else ():
                if child.name == keep:
                    continue
                if child.is_dir():
                    shutil.rmtree(child, ignore_errors=True)
                else:
                    child.unlink(missing_ok=True)
            if keep is None and folder.is_dir():
                shutil.rmtree(folder, ignore_errors=True)

        await asyncio.to_thread(remove)

    async def stage(self, files: Iterable[tuple[str, str]], folder: Path) -> int:
        """Copy files, given as (key, path relative to ``folder``), into a local folder; returns the bytes."""
        total = 0
        for key, relative in files:
            target = folder / _checked(relative)
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as out:
                async for chunk in self.read(key):
                    total += await asyncio.to_thread(out.write, chunk)
        return total

    async def healthy(self) -> bool:
        """Whether the store can be written to."""
        try:
            await obstore.put_async(self._store, "health", b"ok")
        except Exception as error:
            if not isinstance(error, OSError | obstore.exceptions.BaseError):
                raise
            return False
        return True


def _checked(key: str) -> str:
    parts = PurePosixPath(key).parts
    if not parts or key.startswith("/") or any(part in (".", "..", "") for part in key.split("/")):
        raise ValueError(f"not a key: {key!r}")
    return key

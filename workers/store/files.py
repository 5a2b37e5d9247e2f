"""The file store, based on obstore: callers see keys, sizes, digests and byte streams.

The kind of storage (`workers.store.file_places`) makes no difference to callers. Layout:
``datasets/{id}/files/{path}``, ``jobs/{id}/checkpoints/{attempt}-{token}-{n}/…``,
``jobs/{id}/results/{attempt}-{token}/…``, ``jobs/{id}/logs/{attempt}-{token}.txt``.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import obstore
from obstore.exceptions import BaseError

from biresnerf.errors import InputError
from biresnerf.wire.base import Record
from workers.settings.errors import EngineError, LimitReached, NotFound, Unavailable
from workers.settings.settings import Settings
from workers.store.file_places import Bucket, BucketPlace, LocalPlace, Method, Place
from workers.store.measured_stream import MeasuredStream

if TYPE_CHECKING:
    from obstore import ObjectMeta

logger = logging.getLogger(__name__)

CHUNK_BYTES = 2**20
PART_BYTES = 8 * 2**20
# Up to this size a file goes to the store in one request, from memory.
SINGLE_BYTES = 4 * 2**20
HEALTH_S = 5.0
# How "no space left on device" and "file name too long" appear in the store's errors.
_FULL = "(os error 28)"
_TOO_LONG = "(os error 36)"


class StoredFile(Record):
    """A file in the store; ``sha256`` is known only to its writer."""

    key: str
    size: int
    etag: str
    modified_at: datetime
    sha256: str | None = None


class FileStore:
    """Files by key. Writes are atomic: a reader sees the old file, the new one or none, never a part.

    Keys are relative paths with ``/``; a key with an empty, ``.`` or ``..`` part is refused (`ValueError`).
    Every method raises `Unavailable` (``storage_unavailable``) if the store does not answer, and `InputError`
    (``unsafe_path``) for a key that is too long for it.
    """

    def __init__(self, place: Place) -> None:
        self._place, self._store = place, place.store

    async def put(
        self,
        key: str,
        chunks: AsyncIterable[bytes],
        *,
        limit_bytes: int,
        expected_sha256: str | None = None,
        media_type: str | None = None,
    ) -> StoredFile:
        """Store a byte stream of at most ``limit_bytes``, hashing it on the way.

        Raises `LimitReached` (``body_too_large`` at the first byte too many, ``storage_full``), `InputError`
        (``digest_mismatch``) at the end; then nothing is stored, and an older file stays.
        """
        _checked(key)
        incoming = MeasuredStream(key, chunks, limit_bytes, expected_sha256)
        head = await incoming.first(SINGLE_BYTES)
        content = head if incoming.ended else incoming.all_with(head)
        attributes = self._place.attributes(media_type)
        try:
            with _told(f"Cannot store {key}"):
                # A small file in one request; a large one in parts, of which few are in memory.
                await obstore.put_async(
                    self._store,
                    key,
                    content,
                    attributes=attributes,
                    use_multipart=not incoming.ended,
                    chunk_size=PART_BYTES,
                    max_concurrency=2,
                )
        except (EngineError, FileNotFoundError) as error:
            if incoming.failure is not None:  # aborting the parts may have failed in turn
                raise incoming.failure from None
            if isinstance(error, FileNotFoundError):
                raise Unavailable("storage_unavailable", f"Cannot store {key}: no such bucket.") from error
            raise
        return (await self.head(key)).model_copy(update={"sha256": incoming.sha256})

    async def put_bytes(self, key: str, content: bytes) -> StoredFile:
        """Store these bytes; raises `LimitReached` (``storage_full``)."""

        async def chunks() -> AsyncIterator[bytes]:
            yield content

        return await self.put(key, chunks(), limit_bytes=len(content))

    async def put_path(
        self,
        key: str,
        path: Path,
        media_type: str | None = None,
        *,
        limit_bytes: int = 2**62,
        expected_sha256: str | None = None,
    ) -> StoredFile:
        """Store a local file, as `put` does. It is opened once, so a writer may replace it by renaming."""
        with path.open("rb") as file:

            async def chunks() -> AsyncIterator[bytes]:
                while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
                    yield chunk

            return await self.put(
                key,
                chunks(),
                limit_bytes=limit_bytes,
                expected_sha256=expected_sha256,
                media_type=media_type,
            )

    async def copy(self, source: str, target: str) -> StoredFile:
        """Copy within the store; raises `NotFound` if there is no ``source``."""
        _checked(source)
        try:
            with _told(f"Cannot copy {source}"):
                await obstore.copy_async(self._store, source, _checked(target))
        except FileNotFoundError:
            raise NotFound(f"No file {source}.") from None
        return await self.head(target)

    async def head(self, key: str) -> StoredFile:
        """Size, ETag and time of a file; raises `NotFound`."""
        try:
            with _told(f"Cannot look at {key}"):
                meta = await obstore.head_async(self._store, _checked(key))
        except FileNotFoundError:
            raise NotFound(f"No file {key}.") from None
        return _stored(key, meta)

    async def read(self, key: str, start: int = 0, end: int | None = None) -> AsyncIterator[bytes]:
        """The bytes ``[start, end)`` of a file, in chunks; ``end`` None means the file's end.

        Raises `NotFound` only at the first chunk, so call `head` before responding to a client.
        """
        info = await self.head(key)
        stop = info.size if end is None else min(end, info.size)
        while start < stop:
            until = min(stop, start + self._place.window_bytes)
            try:
                with _told(f"Cannot read {key}"):
                    result = await obstore.get_async(self._store, key, options={"range": (start, until)})
                    async for chunk in result.stream(min_chunk_size=CHUNK_BYTES):
                        yield bytes(chunk)
            except FileNotFoundError:
                raise NotFound(f"No file {key}.") from None
            start = until

    async def list(self, prefix: str) -> list[StoredFile]:
        """All files whose key starts with the folder ``prefix``, sorted by key."""
        found: list[StoredFile] = []
        with _told(f"Cannot list {prefix}"):
            async for batch in obstore.list(self._store, prefix=_checked(prefix.rstrip("/"))):
                found += [_stored(meta["path"], meta) for meta in batch]
        return sorted(found, key=lambda file: file.key)

    async def delete(self, key: str) -> None:
        """Delete a file; a missing one is no error."""
        with contextlib.suppress(FileNotFoundError), _told(f"Cannot delete {key}"):
            await obstore.delete_async(self._store, _checked(key))

    async def delete_prefix(self, prefix: str, *, keep: str | None = None) -> None:
        """Delete everything under the folder ``prefix``, except the sub-folder named ``keep``."""
        folder = _checked(prefix.rstrip("/"))
        with contextlib.suppress(FileNotFoundError), _told(f"Cannot delete {prefix}"):
            await self._place.delete_folder(folder, keep)

    async def sha256(self, key: str) -> str:
        """The digest of the stored bytes, in hex; raises `NotFound`."""
        digest = hashlib.sha256()
        async for chunk in self.read(key):
            digest.update(chunk)
        return digest.hexdigest()

    async def stage(
        self, files: Iterable[tuple[str, str]], folder: Path, *, to_read_only: bool = False
    ) -> int:
        """Copy files, given as (key, path relative to ``folder``), into a local folder; returns the bytes copied.

        Files ``to_read_only`` are linked where the place allows that: whoever stages them must not write into them.
        """
        total = 0
        for key, relative in files:
            target = folder / _checked(relative)
            target.parent.mkdir(parents=True, exist_ok=True)
            if to_read_only and await self._place.link(_checked(key), target):
                continue
            with target.open("wb") as out:
                async for chunk in self.read(key):
                    total += await asyncio.to_thread(out.write, chunk)
        return total

    def links_into(self, folder: Path) -> bool:
        """Whether files staged `to_read_only` take no room in the folder."""
        return self._place.links_into(folder)

    async def signed_urls(self, method: Method, keys: Sequence[str], valid_s: int) -> Sequence[str] | None:
        """A URL for each key, valid for ``valid_s`` and one method; None if the place has no such URLs."""
        with _told("Cannot sign an address"):
            return await self._place.signed_urls(method, [_checked(key) for key in keys], valid_s)

    async def healthy(self) -> bool:
        """Whether the store can be written to."""
        try:
            async with asyncio.timeout(HEALTH_S):
                await obstore.put_async(self._store, "health", b"ok")
        except Exception as error:
            if not isinstance(error, OSError | BaseError):
                raise
            return False
        return True


def open_files(settings: Settings, *, patience_s: float = 15.0) -> FileStore:
    """The store of this installation; raises `SetupError`. ``patience_s``: see `BucketPlace`."""
    if settings.storage_url is None:
        return FileStore(LocalPlace(settings.files_dir))
    bucket = Bucket.at(
        settings.storage_url,
        endpoint=settings.storage_endpoint,
        public_endpoint=settings.storage_public_endpoint,
        region=settings.storage_region,
        access_key_id=settings.storage_access_key_id,
        secret_access_key=settings.storage_secret_access_key,
    )
    return FileStore(BucketPlace(bucket, patience_s))


@contextlib.contextmanager
def _told(what: str) -> Iterator[None]:
    """Translates the store's errors into the engine's; the originals name paths and hosts, so only the log has them."""
    try:
        yield
    except BaseError as error:
        if _FULL in str(error):
            raise LimitReached("storage_full", f"{what}: the disk is full.") from error
        logger.warning("%s: %s", what, str(error).splitlines()[0])
        if _TOO_LONG in str(error):
            raise InputError(
                "unsafe_path", f"{what}: the name is too long.", hint="Use a shorter name."
            ) from error
        raise Unavailable(
            "storage_unavailable", f"{what}: the store does not answer as it should."
        ) from error


def _stored(key: str, meta: ObjectMeta) -> StoredFile:
    etag = (meta["e_tag"] or "").strip('"')
    return StoredFile(key=key, size=meta["size"], etag=etag, modified_at=meta["last_modified"])


def _checked(key: str) -> str:
    parts = PurePosixPath(key).parts
    if not parts or key.startswith("/") or any(part in (".", "..", "") for part in key.split("/")):
        raise ValueError(f"not a key: {key!r}")
    return key

"""Fetches uploads from users' addresses, in dispatchers: only they may reach the internet.

Data is stored in pieces, as for clients' uploads, so an interrupted fetch resumes where it stopped if the file is
unchanged. A web process then adds the upload to its dataset. Addresses are secrets: logs and errors contain only their
host.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import secrets
import time
from collections.abc import AsyncIterator
from typing import Any

from psycopg.types.json import Jsonb

from biresnerf import __version__
from workers.database.database import Database
from workers.database.notifications import Listener
from workers.datasets.uploads import PIECE_MAX_BYTES, UploadStore, require_size
from workers.jobs.quotas import require_byte_quota
from workers.process.disk_space import DiskBudget
from workers.records import Upload
from workers.settings.errors import Conflict, NotFound, Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import discard
from workers.webhooks.outbound import TROUBLES, Answer, Outbound
from workers.webhooks.transfers import (
    HEAD_S,
    IDLE_S,
    SLOW_S,
    SLOWEST_BYTES_PER_S,
    TransferFailed,
    TransferWork,
)

log = logging.getLogger(__name__)

_MINE = "state = 'receiving' AND EXISTS (SELECT 1 FROM upload_fetches WHERE id = uploads.id AND token = %s)"
_RANGE = re.compile(r"bytes (\d{1,18})-\d{1,18}/(\d{1,18})")


class Fetcher(TransferWork):
    """Runs in every dispatcher; several may."""

    at_once, per_tenant, rounds_max = 16, 8, 5
    table = "upload_fetches"
    owners = "JOIN uploads USING (id) JOIN datasets ON datasets.id = uploads.dataset_id WHERE true"
    raised = (Unavailable, NotFound, Conflict)

    def __init__(
        self, database: Database, files: FileStore, listener: Listener, outbound: Outbound, settings: Settings
    ) -> None:
        super().__init__(database, listener, outbound, settings)
        self._files, self._uploads = files, UploadStore(database, files, settings)
        local = [settings.files_dir] if settings.storage_url is None else []
        self._disk = DiskBudget(local, settings.disk_reserve_bytes) if local else None

    async def _do(self, row: dict[str, Any]) -> None:
        with contextlib.suppress(NotFound, Conflict):  # deleted, or another process has it
            before = await self._uploads.get(row["id"])
            failed = await self._attempt(row)
            if failed is not None:
                await self._set_back(row, before, failed)

    async def _set_back(self, row: dict[str, Any], before: Upload, failed: TransferFailed) -> None:
        """Schedule a retry, or reject the upload. Only consecutive tries that bring little data are counted."""
        now = await self._uploads.get(before.id)
        round_ = 0 if now.received - before.received >= PIECE_MAX_BYTES else row["round"] + 1
        if await self._comes_again(row, failed, round_):
            return
        error = failed.error(now.host, now.path or "the archive", "fetch_failed")
        log.info("upload %s is rejected: %s", now.id, error)
        async with self._database.transaction() as connection:
            # Locks the upload first, then its address, as deleting it does.
            ours = await connection.row(
                f"UPDATE uploads SET state = 'rejected', error = %s WHERE id = %s AND {_MINE} RETURNING folder",
                *(Jsonb(error.model_dump()), now.id, self._token),
            )
            if ours is not None:
                await self._forget(connection, now.id)
                await connection.execute("DELETE FROM upload_pieces WHERE upload_id = %s", (now.id,))
                await discard(connection, now.folder)

    async def _transfer(self, row: dict[str, Any]) -> None:
        upload = await self._uploads.get(row["id"])
        headers = {"User-Agent": f"BiResNeRF/{__version__}", "Accept-Encoding": "identity"}
        if upload.received and row["etag"]:
            headers |= {"Range": f"bytes={upload.received}-", "If-Range": row["etag"]}
        async with self._outbound.get(row["url"], headers, head_s=HEAD_S, idle_s=IDLE_S) as (
            answer,
            chunks,
        ):
            start, total = _extent(answer, upload.received, row["etag"])
            if start is None:
                await self._begun(upload, 0, None)
                raise TransferFailed("does not send the rest of the file", again=True)
            if row["size"] is not None and total not in {None, row["size"]}:
                raise _other_size(total, row["size"])
            require_size(self._settings, upload.kind, total or 0)
            etag = answer.headers.get("etag", "")
            upload = await self._begun(upload, start, etag if etag.startswith('"') else None)
            await self._store(upload, chunks, total, row["size"])

    async def _begun(self, upload: Upload, start: int, etag: str | None) -> Upload:
        """Keep only the upload's bytes before ``start``, and record the ETag of what follows; returns the upload."""
        async with self._database.transaction() as connection:
            if start < upload.received:
                # A new folder: a lost process may still write into the old one, which is discarded.
                folder = f"datasets/{upload.dataset_id}/uploads/{upload.id}-{secrets.token_hex(4)}"
                await connection.execute("DELETE FROM upload_pieces WHERE upload_id = %s", (upload.id,))
                await connection.execute(
                    "UPDATE uploads SET received = 0, folder = %s WHERE id = %s", (folder, upload.id)
                )
                await discard(connection, upload.folder)
            await connection.required_row(
                f"No upload {upload.id}.",
                "UPDATE upload_fetches SET etag = %s WHERE id = %s AND token = %s RETURNING id",
                *(etag, upload.id, self._token),
            )
        return await self._uploads.get(upload.id)

    async def _store(
        self, upload: Upload, chunks: AsyncIterator[bytes], total: int | None, said: int | None
    ) -> None:
        began, before, piece = time.monotonic(), upload.received, bytearray()

        async def add() -> None:
            nonlocal upload
            upload = await self._add(upload, bytes(piece), max(total or 0, upload.received + len(piece) + 1))
            piece.clear()

        try:
            async for chunk in chunks:
                piece += chunk
                have = upload.received + len(piece)
                require_size(self._settings, upload.kind, have)
                if said is not None and have > said:
                    raise _other_size(have, said)
                if have - before < (time.monotonic() - began - SLOW_S) * SLOWEST_BYTES_PER_S:
                    raise TimeoutError
                if len(piece) >= PIECE_MAX_BYTES:
                    await add()
        except TROUBLES:
            if piece:
                await add()  # what arrived is kept
            raise
        have = upload.received + len(piece)
        if total is not None and have != total:
            raise TransferFailed("sent a part of the file only", again=True)
        if said is not None and have != said:
            raise _other_size(have, said)
        await self._add(upload, bytes(piece), have)

    async def _add(self, upload: Upload, piece: bytes, size: int) -> Upload:
        """Store a piece of an upload of ``size`` bytes, as far as is known; the last piece makes it received.

        Raises `Conflict` if another process has it now, `LimitReached` (``quota_exhausted``, ``storage_full``).
        """
        if self._disk is not None:
            await asyncio.to_thread(self._disk.require, size - upload.received)
        end = upload.received + len(piece)
        key = f"{upload.folder}/{upload.received:014d}-{secrets.token_hex(4)}"
        if piece:
            await self._files.put_bytes(key, piece)
        async with self._database.transaction() as connection:
            ours = await connection.row(
                "UPDATE uploads SET received = %s, size = %s, expires_at = clock_timestamp()"
                " + make_interval(secs => %s), state = CASE WHEN %s THEN 'received' ELSE state END"
                f" WHERE id = %s AND received = %s AND {_MINE} RETURNING id",
                *(end, size, self._settings.upload_expiry_s, end == size),
                *(upload.id, upload.received, self._token),
            )
            if ours is None:
                raise Conflict("offset_mismatch", f"Another process fetches {upload.id}.")
            if piece:
                await connection.execute(
                    "INSERT INTO upload_pieces (upload_id, start, size, key) VALUES (%s, %s, %s, %s)",
                    (upload.id, upload.received, len(piece), key),
                )
                await connection.execute("UPDATE upload_fetches SET losses = 0 WHERE id = %s", (upload.id,))
            if end == size:
                await self._forget(connection, upload.id)
            await require_byte_quota(connection, upload.dataset_id, 0)
        return upload.model_copy(update={"received": end, "size": size})


def _other_size(found: int | None, said: int) -> TransferFailed:
    return TransferFailed(f"Announced were {said} bytes, there are {found}.", code="digest_mismatch")


def _extent(answer: Answer, received: int, etag: str | None) -> tuple[int | None, int | None]:
    """Where the body begins in the file, None if it cannot be used; and the file's size, if stated.

    Raises `TransferFailed`.
    """
    length = answer.headers.get("content-length", "")
    part = _RANGE.fullmatch(answer.headers.get("content-range", ""))
    if answer.status == 200:
        return 0, int(length) if length.isdecimal() and len(length) < 19 else None
    if answer.status in {206, 416}:
        same = part is not None and int(part[1]) == received and answer.headers.get("etag", etag) == etag
        return (received, int(part[2])) if part and same and answer.status == 206 else (None, None)
    raise TransferFailed.of_answer(answer)

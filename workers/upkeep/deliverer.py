"""Sends files of finished jobs to their owners' addresses; runs in dispatchers, like webhooks.

Addresses are secrets: logs and errors contain only their host.
"""

from __future__ import annotations

import logging
import zipfile
from collections.abc import AsyncIterator, Sequence
from typing import Any
from urllib.parse import urlsplit

from biresnerf import __version__
from biresnerf.wire.problems import JobError
from workers.database.database import Database
from workers.database.notifications import Listener
from workers.jobs.deliveries import DUE, lock_for_delivery, note_delivery
from workers.jobs.jobs import JobStore
from workers.records import Artifact
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.webhooks.outbound import Outbound
from workers.webhooks.transfers import SLOW_S, SLOWEST_BYTES_PER_S, TransferFailed, TransferWork
from workers.webhooks.webhook_sender import ROUNDS_MAX

log = logging.getLogger(__name__)

# Stores accept no more in one request, and some programs cannot read the format of larger zips.
ZIP_BYTES_MAX = 2**31 - 1


class Deliverer(TransferWork):
    """Runs in every dispatcher; several may."""

    at_once, per_tenant, rounds_max = 8, 4, ROUNDS_MAX
    table = "job_deliveries"
    owners = DUE

    def __init__(
        self,
        jobs: JobStore,
        database: Database,
        files: FileStore,
        listener: Listener,
        outbound: Outbound,
        settings: Settings,
    ) -> None:
        super().__init__(database, listener, outbound, settings)
        self._jobs, self._files = jobs, files

    async def _do(self, row: dict[str, Any]) -> None:
        failed = await self._attempt(row)
        if failed is not None and await self._comes_again(row, failed, row["round"] + 1):
            return
        host = urlsplit(row["url"]).hostname or ""
        error = (
            None if failed is None else failed.error(host, row["name"] or "archive", code="delivery_failed")
        )
        await self._conclude(row, host, error)

    async def _transfer(self, row: dict[str, Any]) -> None:
        found = await self._jobs.artifacts(row["job_id"])
        if not found:  # for example, the job ended before it ran
            raise TransferFailed("The job has no files.", code="not_found")
        if row["name"] is None:
            size, chunks, kind = zip_bytes(found), zipped(self._files, found), "application/zip"
            if size > ZIP_BYTES_MAX:
                raise TransferFailed(
                    f"The zip would have {size} bytes; have single files sent.", code="body_too_large"
                )
        else:
            artifact = next((item for item in found if item.name == row["name"]), None)
            if artifact is None:
                raise TransferFailed("The job has no file of this name.", code="not_found")
            size, chunks, kind = artifact.size, self._files.read(artifact.key), artifact.media_type
        headers = {"User-Agent": f"BiResNeRF/{__version__}", "Content-Type": kind}
        limit_s = SLOW_S + size / SLOWEST_BYTES_PER_S
        answer = await self._outbound.send("PUT", row["url"], chunks, headers, size=size, timeout_s=limit_s)
        if not 200 <= answer.status < 300:
            raise TransferFailed.of_answer(answer)

    async def _conclude(self, row: dict[str, Any], host: str, error: JobError | None) -> None:
        if error is not None:
            log.info("a file of %s is not delivered: %s", row["job_id"], error)
        async with self._database.transaction() as connection:
            await lock_for_delivery(connection, row["job_id"])
            if await self._forget(connection, row["id"]):
                await note_delivery(connection, row["job_id"], row["name"], host, error)


class _Written:
    """Collects what a zip file writes; it cannot seek, so the zip is written as a stream."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def write(self, part: bytes) -> int:
        self._parts.append(bytes(part))
        return len(part)

    def flush(self) -> None:
        """Nothing to do: writes are not buffered."""

    def taken(self) -> bytes:
        """What was written since the last call."""
        parts, self._parts = self._parts, []
        return b"".join(parts)


def zip_bytes(artifacts: Sequence[Artifact]) -> int:
    """The size of the zip of these files: that of empty files with the same names, plus their contents."""
    written = _Written()
    with zipfile.ZipFile(written, "w") as archive:  # type: ignore[call-overload]
        for artifact in artifacts:
            archive.open(zipfile.ZipInfo(artifact.name), "w").close()
    return len(written.taken()) + sum(artifact.size for artifact in artifacts)


async def zipped(files: FileStore, artifacts: Sequence[Artifact]) -> AsyncIterator[bytes]:
    """The zip of these files, not compressed, so that its size is known in advance."""
    written = _Written()
    with zipfile.ZipFile(written, "w") as archive:  # type: ignore[call-overload]
        for artifact in artifacts:
            with archive.open(zipfile.ZipInfo(artifact.name), "w") as entry:
                async for chunk in files.read(artifact.key):
                    entry.write(chunk)
                    yield written.taken()
    yield written.taken()

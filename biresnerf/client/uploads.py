"""Sends local files to a dataset: only missing ones, in parallel, resuming after a broken connection."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import quote

import anyio
import httpx

from biresnerf.client.errors import ServiceError
from biresnerf.client.retries import Retries
from biresnerf.client.transport import Call, FilePart, Transport, looks, parse, run_together, tell
from biresnerf.wire.datasets import DatasetView, ManifestEntry, UploadView, dataset_url

# Larger files are sent by resumable uploads; smaller ones are sent again as a whole.
RESUMABLE_BYTES = 8 * 2**20
_APPEND_S = 300.0
_TUS = {"Tus-Resumable": "1.0.0"}
_OFFSET_TYPE = {"Content-Type": "application/offset+octet-stream"}


@dataclass(frozen=True)
class LocalFile:
    """A file to send, with the name that it gets in the dataset."""

    name: str
    path: Path
    size: int
    sha256: str

    @classmethod
    def at(cls, name: str, path: Path) -> LocalFile:
        """Reads the file once, for its digest."""
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        return cls(name, path, path.stat().st_size, digest)

    @property
    def entry(self) -> ManifestEntry:
        """The file's entry in a manifest."""
        return ManifestEntry(path=self.name, size=self.size, sha256=self.sha256)


class Uploads(Transport):
    """Sends local files to a dataset."""

    async def send_missing(
        self,
        dataset: DatasetView,
        files: Sequence[LocalFile],
        on_bytes: Callable[[int], object] = lambda _: None,
    ) -> int:
        """Sends those of the files that the dataset lacks; returns how many.

        Args:
            on_bytes: called with the number of further bytes sent; negative after some were lost.
        """
        missing = set(dataset.missing)
        wanted = [file for file in files if file.name in missing]
        await run_together(partial(self._send_file, dataset.id, file, on_bytes) for file in wanted)
        return len(wanted)

    async def send_archive(
        self, dataset: DatasetView, archive: Path, on_bytes: Callable[[int], object] = lambda _: None
    ) -> None:
        """Sends a zip, tar or tar.gz by a resumable upload and waits until it is unpacked."""
        await self._send_resumable(dataset.id, LocalFile.at("", archive), on_bytes)

    async def _send_file(self, dataset_id: str, file: LocalFile, on_bytes: Callable[[int], object]) -> None:
        if file.size > RESUMABLE_BYTES:
            await self._send_resumable(dataset_id, file, on_bytes)
            return
        digest = base64.b64encode(bytes.fromhex(file.sha256)).decode()
        headers = {"Repr-Digest": f"sha-256=:{digest}:"}
        path = f"{dataset_url(dataset_id)}/files/{quote(file.name)}"
        await self._ask(Call("PUT", path, content=FilePart(file.path, 0, file.size), headers=headers))
        await tell(on_bytes, file.size)

    async def _send_resumable(
        self, dataset_id: str, file: LocalFile, on_bytes: Callable[[int], object]
    ) -> None:
        address = await self._begin_upload(dataset_id, file)
        offset, retries, progress = 0, Retries(self._policy), _SentBytes(on_bytes)
        while offset < file.size:
            try:
                arrived = _offset_of(await self._send(_append(address, file, offset, progress)))
            except ServiceError as error:
                if not (error.retryable or error.code == "offset_mismatch"):
                    raise
                arrived = _offset_of(await self._ask(Call("HEAD", address, headers=_TUS)))
                if arrived > offset:
                    retries.progressed()
                else:
                    await anyio.sleep(retries.pause_after(error))
            await progress.confirm(arrived - offset)
            offset = arrived
        await self._until_stored(address)

    async def _begin_upload(self, dataset_id: str, file: LocalFile) -> str:
        metadata = {"sha256": file.sha256, **({"path": file.name} if file.name else {})}
        pairs = (f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in metadata.items())
        headers = {**_TUS, "Upload-Length": str(file.size), "Upload-Metadata": ",".join(pairs)}
        # Sent twice, it creates a second upload that stays empty and expires: no harm.
        begun = await self._ask(Call("POST", f"{dataset_url(dataset_id)}/uploads", headers=headers))
        return begun.headers["location"]

    async def _until_stored(self, address: str) -> None:
        async for _ in looks():
            upload = parse(await self._ask(Call("GET", address)), UploadView)
            if upload.state == "stored":
                return
            if upload.error is not None:
                raise ServiceError.of(upload.error, status=422)


class _SentBytes:
    """Reports bytes as they are sent, and corrects the sum if not all of them arrived."""

    def __init__(self, on_bytes: Callable[[int], object]) -> None:
        self._on_bytes, self._unconfirmed = on_bytes, 0

    async def __call__(self, count: int) -> None:
        self._unconfirmed += count
        await tell(self._on_bytes, count)

    async def confirm(self, arrived: int) -> None:
        """``arrived`` bytes have arrived since the last call."""
        lost, self._unconfirmed = self._unconfirmed - arrived, 0
        if lost:
            await tell(self._on_bytes, -lost)


def _append(address: str, file: LocalFile, offset: int, on_bytes: _SentBytes) -> Call:
    return Call(
        "PATCH",
        address,
        content=FilePart(file.path, offset, file.size, on_bytes),
        headers={**_TUS, **_OFFSET_TYPE, "Upload-Offset": str(offset)},
        answer_s=_APPEND_S,
    )


def _offset_of(answer: httpx.Response) -> int:
    return int(answer.headers["upload-offset"])

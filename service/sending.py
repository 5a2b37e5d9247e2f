"""Files of this machine into a dataset: only what is missing, in parallel, on from where a connection broke."""

from __future__ import annotations

import base64
import hashlib
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from urllib.parse import quote

import httpx

from biresnerf.wire.datasets import DatasetView, ManifestEntry, UploadView
from service.client import Client, ServiceError

# A file above this size is sent so that a broken connection costs a part of it; below, it is sent again.
RESUMABLE_BYTES = 8 * 2**20
LANES = 4
_CHUNK = 2**18
_POLL_S, _LONGEST_POLL_S = 0.5, 5.0
_TUS = {"Tus-Resumable": "1.0.0"}
_OFFSET_TYPE = {"Content-Type": "application/offset+octet-stream"}


@dataclass(frozen=True)
class LocalFile:
    """A file to send, under the name it gets in the dataset."""

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
        """The file as a manifest has it."""
        return ManifestEntry(path=self.name, size=self.size, sha256=self.sha256)


def send_missing(client: Client, dataset: DatasetView, files: Sequence[LocalFile]) -> int:
    """Sends those of the files that the dataset lacks; returns how many. Raises `ServiceError`."""
    missing = set(dataset.missing)
    wanted = [file for file in files if file.name in missing]
    stop = Event()
    with ThreadPoolExecutor(LANES) as lanes:
        sends = [lanes.submit(_send, client, dataset, file, stop) for file in wanted]
        try:
            done, _ = wait(sends, return_when=FIRST_EXCEPTION)
            for send in done:
                send.result()
        finally:
            stop.set()  # where one failed, or Ctrl-C came, the others end at their next piece
            for send in sends:
                send.cancel()
    return len(wanted)


def send_archive(client: Client, dataset: DatasetView, archive: Path) -> None:
    """Sends an archive so that breaks cost little; waits until it is unpacked. Raises `ServiceError`."""
    _send_resumable(client, dataset, LocalFile.at("", archive), Event())


def _send(client: Client, dataset: DatasetView, file: LocalFile, stop: Event) -> None:
    if file.size > RESUMABLE_BYTES:
        _send_resumable(client, dataset, file, stop)
    elif not stop.is_set():
        client.patiently(lambda: _send_whole(client, dataset, file, stop))


def _send_whole(client: Client, dataset: DatasetView, file: LocalFile, stop: Event) -> None:
    digest = base64.b64encode(bytes.fromhex(file.sha256)).decode()
    headers = {"Repr-Digest": f"sha-256=:{digest}:", "Content-Length": str(file.size)}
    client.send(
        "PUT", f"{dataset.links.files}/{quote(file.name)}", content=_from(file, 0, stop), headers=headers
    )


def _send_resumable(client: Client, dataset: DatasetView, file: LocalFile, stop: Event) -> None:
    said = {"sha256": file.sha256, **({"path": file.name} if file.name else {})}
    pairs = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in said.items())
    headers = {**_TUS, "Upload-Length": str(file.size), "Upload-Metadata": pairs}
    begun = client.patiently(lambda: client.send("POST", dataset.links.uploads, headers=headers))
    address, offset = begun.headers["Location"], 0

    def where() -> int:
        return int(client.send("HEAD", address, headers=_TUS).headers["Upload-Offset"])

    def go_on() -> int:
        start = where()
        try:
            return _append(client, address, file, start, stop)
        except ServiceError as error:
            if stop.is_set() or not (error.retryable or error.code == "offset_mismatch"):
                raise
            now = client.patiently(where)
            if now > start:
                return now  # some of it got through: patience begins anew
            raise

    while offset < file.size:
        offset = client.patiently(go_on)
    _wait_until_stored(client, address)


def _append(client: Client, address: str, file: LocalFile, offset: int, stop: Event) -> int:
    headers = {**_TUS, **_OFFSET_TYPE, "Upload-Offset": str(offset)}
    headers["Content-Length"] = str(file.size - offset)
    timeout = httpx.Timeout(30.0, read=300.0, write=120.0)
    answer = client.send(
        "PATCH", address, content=_from(file, offset, stop), headers=headers, timeout=timeout
    )
    return int(answer.headers["Upload-Offset"])


def _wait_until_stored(client: Client, address: str) -> None:
    pause_s = _POLL_S
    while True:
        upload = client.patiently(lambda: client.ask(UploadView, "GET", address))
        if upload.state == "stored":
            return
        if upload.error is not None:
            error = upload.error
            raise ServiceError(error.code, error.detail, status=422, where=error.where, mend=error.mend)
        time.sleep(pause_s)
        pause_s = min(1.5 * pause_s, _LONGEST_POLL_S)  # unpacking a large set takes a while


def _from(file: LocalFile, offset: int, stop: Event) -> Iterator[bytes]:
    with file.path.open("rb") as source:
        source.seek(offset)
        while chunk := source.read(_CHUNK):
            if stop.is_set():
                raise ServiceError("stopped", f"{file.name} was not sent to its end.")
            yield chunk

"""Files of this machine into a dataset: only what is missing, in parallel, on from where a connection broke."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from urllib.parse import quote

from biresnerf.client.calls import Answer, Call, FilePart, Flow, Patience, Pause, Session, Together, ask
from biresnerf.client.errors import ServiceError
from biresnerf.wire.datasets import DatasetView, ManifestEntry, UploadView, dataset_url

# A file above this size is sent so that a broken connection costs a part of it; below, it is sent again.
RESUMABLE_BYTES = 8 * 2**20
_APPEND_S = 300.0
_POLL_S, _LONGEST_POLL_S = 0.3, 5.0
_TUS = {"Tus-Resumable": "1.0.0"}
_OFFSET_TYPE = {"Content-Type": "application/offset+octet-stream"}
OnBytes = Callable[[int], None]


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


def send_missing(
    session: Session, dataset: DatasetView, files: Sequence[LocalFile], on_bytes: OnBytes = lambda _: None
) -> Flow[int]:
    """Sends those of the files that the dataset lacks; returns how many.

    Args:
        on_bytes: hears how many bytes more were sent, from several threads; fewer than none where some were lost.
    """
    missing = set(dataset.missing)
    wanted = [file for file in files if file.name in missing]
    stop = Event()
    yield Together([_send(session, dataset.id, file, stop, on_bytes) for file in wanted], stop)
    return len(wanted)


def send_archive(
    session: Session, dataset: DatasetView, archive: Path, on_bytes: OnBytes = lambda _: None
) -> Flow[None]:
    """Sends a zip, tar or tar.gz so that breaks cost little; waits until it is unpacked."""
    stop = Event()
    file = LocalFile.at("", archive)
    yield Together([_send_resumable(session, dataset.id, file, stop, on_bytes)], stop)


def _send(session: Session, dataset_id: str, file: LocalFile, stop: Event, on_bytes: OnBytes) -> Flow[None]:
    if file.size > RESUMABLE_BYTES:
        yield from _send_resumable(session, dataset_id, file, stop, on_bytes)
        return
    digest = base64.b64encode(bytes.fromhex(file.sha256)).decode()
    headers = {"Repr-Digest": f"sha-256=:{digest}:"}
    path = f"{dataset_url(dataset_id)}/files/{quote(file.name)}"
    call = Call("PUT", path, content=FilePart(file.path, 0, file.size, stop), headers=headers)
    yield from ask(session, call)
    on_bytes(file.size)


def _send_resumable(
    session: Session, dataset_id: str, file: LocalFile, stop: Event, on_bytes: OnBytes
) -> Flow[None]:
    said = {"sha256": file.sha256, **({"path": file.name} if file.name else {})}
    pairs = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in said.items())
    headers = {**_TUS, "Upload-Length": str(file.size), "Upload-Metadata": pairs}
    # Asked for twice, there would be a second one, empty until it expires: no harm.
    begun = yield from ask(session, Call("POST", f"{dataset_url(dataset_id)}/uploads", headers=headers))
    address, offset = begun.headers["location"], 0
    patience = Patience(session)
    while offset < file.size:
        sent = _Sent(on_bytes)
        try:
            now = _offset((yield _append(address, file, offset, stop, sent)))
        except ServiceError as error:
            if stop.is_set() or not (error.retryable or error.code == "offset_mismatch"):
                raise
            now = _offset((yield from ask(session, Call("HEAD", address, headers=_TUS))))
            if now > offset:
                patience.renew()  # some of it got through
            else:
                yield Pause(patience.after(error))
        sent.settle(now - offset)
        offset = now
    yield from _until_stored(session, address)


class _Sent:
    """Tells of bytes as they leave, and takes back those that did not arrive."""

    def __init__(self, on_bytes: OnBytes) -> None:
        self._on_bytes, self._told = on_bytes, 0

    def __call__(self, count: int) -> None:
        self._told += count
        self._on_bytes(count)

    def settle(self, arrived: int) -> None:
        """So many have arrived."""
        if arrived != self._told:
            self._on_bytes(arrived - self._told)


def _append(address: str, file: LocalFile, offset: int, stop: Event, sent: _Sent) -> Call:
    return Call(
        "PATCH",
        address,
        content=FilePart(file.path, offset, file.size, stop, sent),
        headers={**_TUS, **_OFFSET_TYPE, "Upload-Offset": str(offset)},
        answer_s=_APPEND_S,
    )


def _offset(answer: Answer) -> int:
    return int(answer.headers["upload-offset"])


def _until_stored(session: Session, address: str) -> Flow[None]:
    pause_s = _POLL_S
    while True:
        upload = (yield from ask(session, Call("GET", address))).model(UploadView)
        if upload.state == "stored":
            return
        if upload.error is not None:
            raise ServiceError.of(upload.error, status=422)
        yield Pause(pause_s)
        pause_s = min(1.5 * pause_s, _LONGEST_POLL_S)  # unpacking a large set takes a while

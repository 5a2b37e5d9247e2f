"""Files of a result onto this machine: whole or not at all, on from where a connection or a process broke off."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from threading import Event
from typing import BinaryIO

from biresnerf.client.calls import Call, Flow, Patience, Pause, Session, Stream, Together, Work
from biresnerf.client.errors import ServiceError
from biresnerf.client.job_calls import artifacts
from biresnerf.errors import InputError
from biresnerf.wire.results import ArtifactView
from biresnerf.wire.safe_paths import checked_path

OnBytes = Callable[[int], None]


class PartialFile:
    """What has arrived of a file, beside its place until all of it is there. A later run goes on with it."""

    def __init__(self, artifact: ArtifactView, target: Path, on_bytes: OnBytes) -> None:
        self.artifact, self._target, self._on_bytes = artifact, target, on_bytes
        # Named by content: parts of another file of the name are not taken for this one's.
        self._path = target.with_name(f".{target.name[:200]}.{artifact.sha256[:12]}.part")
        self._digest, self.size = hashlib.sha256(), 0
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Takes up what an earlier run left."""
        self._target.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("a+b")
        self._file.seek(0)
        while chunk := self._file.read(2**20):
            self._digest.update(chunk)
            self.size += len(chunk)
        self._on_bytes(self.size)

    def rest(self) -> Call:
        """The request for what lacks."""
        headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
        if self.size:
            headers |= {"Range": f"bytes={self.size}-", "If-Range": f'"{self.artifact.sha256}"'}
        return Call("GET", self.artifact.href, headers=headers)

    def begin(self, status: int) -> None:
        """Where the answer is not the part that was asked for, it is the whole."""
        if status != 206 and self.size:
            self._restart()

    def _restart(self) -> None:
        if self._file is not None:
            self._file.truncate(0)
        self._on_bytes(-self.size)
        self._digest, self.size = hashlib.sha256(), 0

    def take(self, chunk: bytes) -> None:
        """The next bytes."""
        if self._file is not None:
            self._file.write(chunk)
        self._digest.update(chunk)
        self.size += len(chunk)
        self._on_bytes(len(chunk))

    def close(self) -> None:
        """Keeps what has arrived, for a later run."""
        if self._file is not None:
            self._file.close()
            self._file = None
        if not self.size:
            self._path.unlink(missing_ok=True)

    def finish(self) -> None:
        """Puts the file in its place; raises `ServiceError` ``download_damaged``."""
        self.close()
        if self.size != self.artifact.size or self._digest.hexdigest() != self.artifact.sha256:
            self._path.unlink(missing_ok=True)
            raise ServiceError("download_damaged", f"{self.artifact.name} arrived damaged; try again.")
        if not self.size:
            self._path.touch()
        os.replace(self._path, self._target)


def download(
    session: Session, artifact: ArtifactView, target: Path, *, on_bytes: OnBytes = lambda _: None
) -> Flow[None]:
    """Writes one file of a result to ``target``. Does not ask whether something is there already."""
    part = PartialFile(artifact, target, on_bytes)
    try:
        yield Work(part.open)
        patience, before = Patience(session), part.size
        while part.size < artifact.size:
            try:
                yield Stream(part.rest(), part)
            except ServiceError as error:
                if part.size > before:
                    patience.renew()
                before = part.size
                yield Pause(patience.after(error))
        part.finish()
    finally:
        part.close()


def download_all(
    session: Session,
    job_id: str,
    folder: Path,
    *,
    names: Sequence[str] = ("*",),
    replace: bool = False,
    on_bytes: Callable[[int, int], None] = lambda _done, _total: None,
) -> Flow[list[Path]]:
    """Writes the files of a result below ``folder``; gives their paths. What is there already is not sent again.

    Args:
        names: of the files, with ``*`` and ``?``; a folder stands for all in it.
        replace: whether files of other content give way.
        on_bytes: hears how many bytes more there are, of how many.

    Raises:
        InputError: ``output_not_empty`` where a file of other content is in the way, ``no_such_file``.
    """
    found = chosen_files((yield from artifacts(session, job_id)), names)
    # The names come from a server that need not be trusted.
    targets = [(artifact, folder / checked_path(artifact.name)) for artifact in found]
    wanted = yield Work(lambda: [(a, target) for a, target in targets if not _there(a, target, replace)])
    total = sum(artifact.size for artifact, _ in wanted)

    def count(more: int) -> None:
        on_bytes(more, total)

    stop = Event()
    yield Together([download(session, a, target, on_bytes=count) for a, target in wanted], stop)
    return [target for _, target in targets]


def chosen_files(found: Sequence[ArtifactView], names: Sequence[str]) -> list[ArtifactView]:
    """Those of the names; raises `InputError` ``no_such_file`` for a name of none."""
    chosen: dict[str, ArtifactView] = {}
    for name in names:
        folder = name.rstrip("/") + "/"
        fitting = {a.name: a for a in found if fnmatchcase(a.name, name) or a.name.startswith(folder)}
        if not fitting and name != "*":
            raise InputError(
                "no_such_file",
                "is no file of the result.",
                where=name,
                hint=f"There are {', '.join(a.name for a in found[:30])}."
                if found
                else "There are none yet.",
            )
        chosen |= fitting
    return list(chosen.values())


def _there(artifact: ArtifactView, target: Path, replace: bool) -> bool:
    if not target.exists():
        return False
    if target.is_file() and target.stat().st_size == artifact.size:
        with target.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() == artifact.sha256:
                return True
    if replace and target.is_file():
        return False
    raise InputError(
        "output_not_empty", "is there with other content.", where=str(target), hint="Name another folder."
    )

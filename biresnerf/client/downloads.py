"""Downloads files of a result: complete or not at all, resuming after a broken connection or a killed process."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import anyio
import httpx
from anyio import from_thread, to_thread

from biresnerf.client.errors import ServiceError
from biresnerf.client.job_calls import JobCalls
from biresnerf.client.retries import Retries
from biresnerf.client.transport import Call, run_together, tell
from biresnerf.errors import InputError
from biresnerf.wire.results import ArtifactView
from biresnerf.wire.safe_paths import checked_path

if TYPE_CHECKING:
    from biresnerf.result import Result

_REDIRECTIONS = frozenset({301, 302, 303, 307, 308})


class Downloads(JobCalls):
    """Downloads files of results."""

    async def download(
        self, artifact: ArtifactView, target: Path, *, on_bytes: Callable[[int], object] = lambda _: None
    ) -> None:
        """Writes one file of a result to ``target``, replacing what is there.

        Args:
            on_bytes: called with the number of further bytes; negative where a resumed download starts over.
        """
        part = _PartialFile(artifact, target)
        try:
            await to_thread.run_sync(part.open)
            await tell(on_bytes, part.size)
            retries, before = Retries(self._policy), part.size
            while part.size < artifact.size:
                try:
                    await self._fetch_rest(part, on_bytes)
                except ServiceError as error:
                    if part.size > before:
                        retries.progressed()
                    before = part.size
                    await anyio.sleep(retries.pause_after(error))
            part.finish()
        finally:
            part.close()

    async def _fetch_rest(self, part: _PartialFile, on_bytes: Callable[[int], object]) -> None:
        call: Call | None = part.request()
        while call is not None:
            async with self._open(call) as response:
                call = _redirected(call, response)
                if call is not None:
                    continue
                if response.status_code != 206 and part.size:
                    await tell(on_bytes, -part.size)
                    part.restart()
                async for chunk in response.aiter_raw():
                    part.append(chunk)
                    await tell(on_bytes, len(chunk))

    async def download_all(
        self,
        job_id: str,
        folder: Path,
        *,
        names: Sequence[str] = ("*",),
        replace: bool = False,
        on_bytes: Callable[[int, int], object] = lambda _more, _total: None,
    ) -> list[Path]:
        """Writes the files of a result below ``folder``; returns their paths. Skips those that are there already.

        Args:
            names: of the files, with ``*`` and ``?``; a folder stands for all files in it.
            replace: whether to overwrite files that differ.
            on_bytes: called with the number of further bytes, and the number of all bytes to download.

        Raises:
            InputError: ``output_not_empty`` for a file that differs, ``no_such_file`` for an unknown name.
        """
        found = choose_files(await self.artifacts(job_id), names)
        # The names come from a server that need not be trusted.
        targets = [(artifact, folder / checked_path(artifact.name)) for artifact in found]
        wanted = []
        for artifact, target in targets:
            if not await to_thread.run_sync(_is_there, artifact, target, replace, abandon_on_cancel=True):
                wanted.append((artifact, target))
        total = sum(artifact.size for artifact, _ in wanted)

        async def count(more: int) -> None:
            await tell(on_bytes, more, total)

        await run_together(partial(self.download, *one, on_bytes=count) for one in wanted)
        return [target for _, target in targets]

    async def result(self, job_id: str, folder: Path) -> Result:
        """Downloads the whole result of a job into ``folder`` and loads it, as `biresnerf.load` does.

        Raises:
            InputError: as `download_all` and `biresnerf.load` do.
        """
        from biresnerf.result import load

        await self.download_all(job_id, folder)
        return await to_thread.run_sync(load, folder)


class _PartialFile:
    """What has arrived of a file, kept beside its target until it is complete, also for a later process."""

    def __init__(self, artifact: ArtifactView, target: Path) -> None:
        self.artifact, self._target = artifact, target
        # The digest in the name keeps parts of another file of this name apart.
        self._path = target.with_name(f".{target.name[:200]}.{artifact.sha256[:12]}.part")
        self._digest, self.size = hashlib.sha256(), 0
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Reads what an earlier download left. Runs in a worker thread."""
        self._target.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("a+b")
        self._file.seek(0)
        while chunk := self._file.read(2**20):
            from_thread.check_cancelled()
            self._digest.update(chunk)
            self.size += len(chunk)

    def request(self) -> Call:
        """The request for the missing bytes."""
        headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
        if self.size:
            headers |= {"Range": f"bytes={self.size}-", "If-Range": f'"{self.artifact.sha256}"'}
        return Call("GET", self.artifact.href, headers=headers)

    def restart(self) -> None:
        """Drops what has arrived."""
        if self._file is not None:
            self._file.truncate(0)
        self._digest, self.size = hashlib.sha256(), 0

    def append(self, chunk: bytes) -> None:
        """Adds the next bytes."""
        if self._file is not None:
            self._file.write(chunk)
        self._digest.update(chunk)
        self.size += len(chunk)

    def close(self) -> None:
        """Keeps what has arrived, for a later download."""
        if self._file is not None:
            self._file.close()
            self._file = None
        if not self.size:
            self._path.unlink(missing_ok=True)

    def finish(self) -> None:
        """Moves the file to its target; raises `ServiceError` ``download_damaged``."""
        self.close()
        if self.size != self.artifact.size or self._digest.hexdigest() != self.artifact.sha256:
            self._path.unlink(missing_ok=True)
            raise ServiceError("download_damaged", f"{self.artifact.name} arrived damaged; try again.")
        if not self.size:
            self._path.touch()
        os.replace(self._path, self._target)


def choose_files(found: Sequence[ArtifactView], names: Sequence[str]) -> list[ArtifactView]:
    """The files with these names; raises `InputError` ``no_such_file`` for a name that none has."""
    chosen: dict[str, ArtifactView] = {}
    for name in names:
        folder = name.rstrip("/") + "/"
        fitting = {a.name: a for a in found if fnmatchcase(a.name, name) or a.name.startswith(folder)}
        if not fitting and name != "*":
            known = f"There are {', '.join(a.name for a in found[:30])}." if found else "There are none yet."
            raise InputError("no_such_file", "is no file of the result.", where=name, hint=known)
        chosen |= fitting
    return list(chosen.values())


def _redirected(call: Call, response: httpx.Response) -> Call | None:
    """The request for the same bytes from the service's object store, if the answer redirects there."""
    if response.status_code not in _REDIRECTIONS:
        return None
    # The store has entity tags of its own; files of a result never change.
    headers = {name: value for name, value in call.headers.items() if name != "If-Range"}
    return Call("GET", response.headers["location"], headers=headers, answer_s=call.answer_s)


def _is_there(artifact: ArtifactView, target: Path, replace: bool) -> bool:
    """Whether the file need not be downloaded; raises `InputError` if another one is in its place."""
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

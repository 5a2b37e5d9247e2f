"""Delivers a job process's reports to the database and the file store, without blocking the process."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from obstore.exceptions import BaseError as StoreError

from biresnerf.progress import Progress
from biresnerf.stages import REUSABLE_STAGES, ReusableStage
from workers.jobs.claim import Fenced
from workers.jobs.ledger import Ledger
from workers.run.results import files_inside, store_artifact
from workers.settings.errors import EngineError
from workers.settings.traces import StageSpans
from workers.store.files import FileStore

log = logging.getLogger(__name__)

PERIOD_S = 1.0
LINE_CHARACTERS_MAX = 2000  # per line of the log
LINES_AT_ONCE = 500
_READ_BYTES = 2**18


class Courier:
    """Delivers every change of stage or options; once a second the latest progress, log, checkpoint and preview.

    `offer` never waits; `run` delivers until `close` and the last delivery. `run` raises `Fenced`.
    """

    def __init__(self, ledger: Ledger, files: FileStore, output: Path, log_file: Path) -> None:
        self._ledger, self._files, self._output = ledger, files, output
        self._undroppable: deque[Progress] = deque()
        self._latest: Progress | None = None
        self._log = _LogLines(log_file)
        self._checkpoints, self._previews = _Box(), _Box()
        self._reusable: dict[ReusableStage, _Box] = {stage: _Box() for stage in REUSABLE_STAGES}
        self._stored = 0
        self._spans = StageSpans()
        self._progress_due = asyncio.Event()
        self._closed = asyncio.Event()

    def offer(self, progress: Progress) -> None:
        """Take note of a report."""
        entered = self._latest is None or progress.stage != self._latest.stage
        if entered:
            self._spans.enter(progress.stage)
        if entered or progress.options is not None:
            self._undroppable.append(progress)
        self._latest = progress
        self._progress_due.set()
        if progress.checkpoint is not None:
            self._checkpoints.put(progress)
        if progress.preview:
            self._previews.put(progress)
        for stage in progress.reusable:
            self._reusable[stage].put(progress)

    def close(self, *, last_checkpoint: bool = True) -> None:
        """Call it after the last report. A cancelled job does not need its ``last_checkpoint``."""
        if not last_checkpoint:
            self._checkpoints.latest = None
        self._closed.set()
        self._progress_due.set()
        for box in (self._checkpoints, self._previews, *self._reusable.values()):
            box.due.set()

    async def run(self) -> None:
        """Deliver until closed and everything is delivered."""
        deliveries = [
            asyncio.create_task(self._carry_progress()),
            asyncio.create_task(self._carry_log()),
            asyncio.create_task(self._carry(self._checkpoints, self._store_checkpoint)),
            asyncio.create_task(self._carry(self._previews, self._store_preview)),
            *(
                asyncio.create_task(self._carry(box, partial(self._store_reusable, stage)))
                for stage, box in self._reusable.items()
            ),
        ]
        try:
            await asyncio.gather(*deliveries)
        finally:
            for task in deliveries:
                task.cancel()
            self._spans.end()

    async def _carry_progress(self) -> None:
        delivered: Progress | None = None
        while True:
            await self._progress_due.wait()
            self._progress_due.clear()
            closed = self._closed.is_set()
            while self._undroppable:
                delivered = self._undroppable.popleft()
                await self._ledger.progress(delivered)
            if self._latest is not None and self._latest is not delivered:
                delivered = self._latest
                await self._ledger.progress(delivered)
            if closed:
                return
            await self._pause()

    async def _carry_log(self) -> None:
        while True:
            closed = self._closed.is_set()
            while lines := await asyncio.to_thread(self._log.fresh, last=closed):
                await self._ledger.log(lines)
            if closed:
                return
            await self._pause()

    async def _pause(self) -> None:
        """Wait for the period; wakes early only when closed."""
        try:
            await asyncio.wait_for(self._closed.wait(), PERIOD_S)
        except TimeoutError:
            return

    async def _carry(self, box: _Box, store: Callable[[Progress], Awaitable[None]]) -> None:
        while True:
            await box.due.wait()
            box.due.clear()
            closed = self._closed.is_set()
            progress, box.latest = box.latest, None
            if progress is not None:
                try:
                    await store(progress)
                except (OSError, ValueError, StoreError, EngineError) as error:
                    # The job can continue: a later file will follow, or the previous one suffices.
                    log.error("a file of %s was not stored: %s", self._ledger.claim.job_id, error)
            if closed:
                return

    async def _store_checkpoint(self, progress: Progress) -> None:
        """Store a new object, then move the pointer: a checkpoint is never overwritten."""
        prefix = self._new_prefix("checkpoints")
        for name, path in files_inside(self._output, [str(progress.checkpoint)]).items():
            await self._files.put_path(f"{prefix}/{name}", path)
            await self._point(prefix, self._ledger.checkpoint(prefix, [name], progress.step))

    async def _store_preview(self, progress: Progress) -> None:
        """The same for previews."""
        prefix = self._new_prefix("previews")
        found = files_inside(self._output, progress.preview)
        try:
            artifacts = [
                await store_artifact(self._files, prefix, name, path) for name, path in sorted(found.items())
            ]
        except FileNotFoundError:
            return  # the job has ended and cleaned up meanwhile
        if artifacts:
            await self._point(prefix, self._ledger.preview(prefix, artifacts, progress))

    async def _store_reusable(self, stage: ReusableStage, progress: Progress) -> None:
        """The same for the work of a stage."""
        prefix = self._new_prefix(f"stages/{stage}")
        found = files_inside(self._output, progress.reusable[stage])
        if len(found) < len(progress.reusable[stage]):
            return
        for name, path in found.items():
            await self._files.put_path(f"{prefix}/{name}", path)
        await self._point(prefix, self._ledger.reusable(stage, prefix, list(found)))

    async def _point(self, prefix: str, writing: Awaitable[None]) -> None:
        try:
            await writing
        except Fenced:
            await self._files.delete_prefix(prefix)  # neither the new owner nor the trash knows it
            raise

    def _new_prefix(self, kind: str) -> str:
        self._stored += 1
        claim = self._ledger.claim
        return f"jobs/{claim.job_id}/{kind}/{claim.name}-{self._stored}"


class _Box:
    """Holds the latest report with something to store; a newer one replaces it."""

    def __init__(self) -> None:
        self.latest: Progress | None = None
        self.due = asyncio.Event()

    def put(self, progress: Progress) -> None:
        self.latest = progress
        self.due.set()


class _LogLines:
    """Returns each line of a file once, as soon as it is complete."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._rest = path, 0, b""
        self._lines: list[str] = []

    def fresh(self, *, last: bool) -> list[str]:
        """The next lines, `LINES_AT_ONCE` at most; empty if there are no more. ``last``: the file is complete."""
        while len(self._lines) < LINES_AT_ONCE and (read := self._read()):
            *whole, self._rest = (self._rest + read).split(b"\n")
            if len(self._rest) > _READ_BYTES:  # too long for a line: split it
                whole, self._rest = [*whole, self._rest], b""
            self._lines += map(_shown, whole)
        if last and self._rest and len(self._lines) < LINES_AT_ONCE:
            self._lines, self._rest = [*self._lines, _shown(self._rest)], b""
        given, self._lines = self._lines[:LINES_AT_ONCE], self._lines[LINES_AT_ONCE:]
        return given

    def _read(self) -> bytes:
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                read = file.read(_READ_BYTES)
        except FileNotFoundError:
            return b""
        self._offset += len(read)
        return read


def _shown(line: bytes) -> str:
    # A progress bar overwrites itself; what it showed last is the line. The database stores no NUL in text.
    text = line.decode(errors="replace").rstrip("\r").rpartition("\r")[2].replace("\0", "\ufffd")
    return text if len(text) <= LINE_CHARACTERS_MAX else text[: LINE_CHARACTERS_MAX - 1] + "\u2026"

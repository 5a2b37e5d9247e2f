"""Carries what a job's process reports to the database and the file store, without ever holding it up."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from pathlib import Path, PurePosixPath

from obstore.exceptions import BaseError as StoreError

from biresnerf.progress import Progress
from workers.errors import EngineError
from workers.files import FileStore
from workers.ledger import Ledger

log = logging.getLogger(__name__)

PROGRESS_PERIOD_S = 1.0


class Courier:
    """Delivers every stage change, the latest progress once a second, and the latest checkpoint.

    `offer` never waits; `run` delivers until `close` and the last delivery. `run` raises `Fenced`.
    """

    def __init__(self, ledger: Ledger, files: FileStore, output: Path) -> None:
        self._ledger, self._files, self._output = ledger, files, output
        self._stages: deque[Progress] = deque()
        self._latest: Progress | None = None
        self._checkpoint: Progress | None = None
        self._checkpoints = 0
        self._progress_due = asyncio.Event()
        self._checkpoint_due = asyncio.Event()
        self._closed = asyncio.Event()

    def offer(self, progress: Progress) -> None:
        """Take note of a report."""
        if self._latest is None or progress.stage != self._latest.stage:
            self._stages.append(progress)
        self._latest = progress
        self._progress_due.set()
        if progress.checkpoint is not None:
            self._checkpoint = progress
            self._checkpoint_due.set()

    def close(self) -> None:
        """No more reports will come."""
        self._closed.set()
        self._progress_due.set()
        self._checkpoint_due.set()

    async def run(self) -> None:
        """Deliver until closed and all is delivered."""
        deliveries = [
            asyncio.create_task(self._carry_progress()),
            asyncio.create_task(self._carry_checkpoints()),
        ]
        try:
            await asyncio.gather(*deliveries)
        finally:
            for task in deliveries:
                task.cancel()

    async def _carry_progress(self) -> None:
        delivered: Progress | None = None
        while True:
            await self._progress_due.wait()
            self._progress_due.clear()
            closed = self._closed.is_set()
            while self._stages:
                delivered = self._stages.popleft()
                await self._ledger.progress(delivered)
            if self._latest is not None and self._latest is not delivered:
                delivered = self._latest
                await self._ledger.progress(delivered)
            if closed:
                return
            # Wakes early for the end only: everything else can wait for the period.
            try:
                await asyncio.wait_for(self._closed.wait(), PROGRESS_PERIOD_S)
            except TimeoutError:
                continue

    async def _carry_checkpoints(self) -> None:
        while True:
            await self._checkpoint_due.wait()
            self._checkpoint_due.clear()
            closed = self._closed.is_set()
            progress, self._checkpoint = self._checkpoint, None
            if progress is not None and progress.checkpoint is not None:
                await self._upload(progress.checkpoint, progress.step)
            if closed:
                return

    async def _upload(self, name: str, step: int) -> None:
        """A new object each time, then the pointer: a checkpoint is never overwritten."""
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            log.error("checkpoint %r lies outside the output folder", name)
            return
        self._checkpoints += 1
        claim = self._ledger.claim
        prefix = f"jobs/{claim.job_id}/checkpoints/{claim.name}-{self._checkpoints}"
        try:
            await self._files.put_path(f"{prefix}/{name}", self._output / name)
        except (OSError, ValueError, StoreError, EngineError) as error:
            # The job can go on without: a later checkpoint, or a resume from an earlier one, will do.
            log.error("checkpoint %s of %s not stored: %s", name, claim.job_id, error)
            return
        await self._ledger.checkpoint(prefix, [name], step)

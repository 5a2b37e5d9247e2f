"""A lane of a slot: takes jobs of some kinds from the queue and runs them one after the other."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from biresnerf.wire.jobs import JobKind
from workers.database import job_queue
from workers.database.database import Database
from workers.database.job_queue import Entry
from workers.database.notifications import Listener
from workers.jobs.claim import Fenced, cancel_requested, claim_job, input_bytes
from workers.jobs.job_states import say_what_it_waits_for
from workers.process.disk_space import job_disk_budget
from workers.process.exit_status import ExitStatus
from workers.process.waiting import first_done, retry_while_unavailable
from workers.run.attempt import Attempt, Ending
from workers.settings.errors import LimitReached, Unavailable
from workers.settings.logs import log_context
from workers.settings.settings import Settings
from workers.settings.traces import span
from workers.store.files import FileStore

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Workplace:
    """What the lanes of one slot share.

    Attributes:
        worker_id: the slot, as the queue knows it.
        scratch: a local folder for the files of running jobs.
        variables: environment variables of jobs.
        stop: once it is set, running jobs write a checkpoint and go back to the queue.
    """

    database: Database
    files: FileStore
    listener: Listener
    settings: Settings
    worker_id: int
    scratch: Path
    variables: Mapping[str, str]
    stop: asyncio.Event


class Lane:
    """Takes jobs of ``kinds``. No two lanes of a slot have a kind in common."""

    def __init__(self, place: Workplace, kinds: Sequence[JobKind]) -> None:
        self._place, self._kinds = place, tuple(kinds)
        self._settings, self._database = place.settings, place.database

    async def run(self, over: asyncio.Event, idle_exit_s: float = math.inf) -> None:
        """Run jobs until ``over`` (after the current one), a stop, or ``idle_exit_s`` without any."""
        while (entry := await self.next(over, idle_exit_s)) is not None:
            await self.work_on(entry)

    async def next(self, over: asyncio.Event, idle_exit_s: float = math.inf) -> Entry | None:
        """Wait for the next queue entry; None if this lane is to end."""
        take = partial(job_queue.take, worker_id=self._place.worker_id, kinds=self._kinds)
        idle_from = time.monotonic()
        with self._place.listener.waiting(job_queue.NEW_ENTRY) as added:
            while not (self._place.stop.is_set() or over.is_set()):
                added.clear()
                try:
                    entry = await self._database.run(take)
                except Unavailable as error:
                    log.warning("the queue cannot be read: %s", error)
                    entry, idle_from = None, time.monotonic()  # it is unknown whether there is work
                if entry is not None:
                    return entry
                left_s = idle_from + idle_exit_s - time.monotonic()
                if left_s <= 0:
                    return None
                pause_s = min(self._settings.poll_s, left_s)
                await first_done(added.wait(), self._place.stop.wait(), over.wait(), asyncio.sleep(pause_s))
        return None

    async def work_on(self, entry: Entry) -> Ending | None:
        """Run the entry's job; returns how the attempt ended, None if there was nothing to run."""
        with log_context(job_id=entry.job_id):
            try:
                ending = await self._run_job(entry)
            except Fenced as fenced:
                log.warning("%s; exiting", fenced)
                os._exit(ExitStatus.FENCED)  # its queue entry belongs to the new owner
            except Exception:  # our own failure must not end the slot
                log.exception("the job goes back to the queue")
                ending = Ending("setback", self._settings.stall_s / 4)
            acknowledge = partial(
                job_queue.acknowledge,
                entry_id=entry.id,
                worker_id=self._place.worker_id,
                again_in_s=ending.again_in_s if ending else None,
            )
            if not await retry_while_unavailable(lambda: self._database.run(acknowledge)):
                log.warning("queue entry %d now belongs to another worker", entry.id)
            return ending

    async def _run_job(self, entry: Entry) -> Ending | None:
        if not await self._fits_on_disk(entry.job_id):
            say = partial(say_what_it_waits_for, job_id=entry.job_id, cause="disk_full")
            await retry_while_unavailable(lambda: self._database.run(say))
            return Ending("setback", self._settings.stall_s / 4)
        claim = await claim_job(
            self._database,
            entry.job_id,
            self._place.worker_id,
            self._settings.max_attempts,
            self._settings.stall_s,
        )
        if claim is None:
            return None
        log.info("attempt %s begins", claim.name)
        place = self._place
        folder = place.scratch / f"{entry.job_id}-{claim.name}"
        attempt = Attempt(self._database, place.files, self._settings, claim, folder, place.variables)
        watching = asyncio.create_task(self._stop_when_asked(entry, attempt))
        try:
            with span("attempt", parent=claim.trace, about={"job": claim.job_id, "number": claim.attempt}):
                return await attempt.run()
        finally:
            watching.cancel()

    async def _stop_when_asked(self, entry: Entry, attempt: Attempt) -> None:
        """Stop the attempt when its job is cancelled, or when the slot is stopped."""
        stop = self._place.stop
        with self._place.listener.waiting(str(entry.id)) as changed:
            while True:
                changed.clear()
                if stop.is_set():
                    attempt.ask_stop("shutdown")
                with contextlib.suppress(Unavailable):
                    if await cancel_requested(self._database, entry.job_id):
                        attempt.ask_stop("cancel")
                        return
                stopped = [] if stop.is_set() else [stop.wait()]
                await first_done(changed.wait(), asyncio.sleep(self._settings.poll_s), *stopped)

    async def _fits_on_disk(self, job_id: str) -> bool:
        """Whether the job's files fit on the local disk. If not, the job waits for space here or on another host."""
        size = 0
        if not self._place.files.links_into(self._place.scratch):
            size = await retry_while_unavailable(lambda: input_bytes(self._database, job_id))
        try:
            job_disk_budget(self._settings).require(size)
        except LimitReached as full:
            log.warning("the job waits for disk space: %s", full.detail)
            return False
        return True

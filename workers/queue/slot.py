"""A slot: a small process that runs one job at a time, each in a child process. Loads no torch, no numpy."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fcntl
import logging
import math
import os
import platform
import re
import shutil
import signal
import sys
import time
from collections.abc import AsyncIterator, Mapping
from functools import partial
from pathlib import Path
from typing import IO

from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.database.job_queue import Entry
from workers.database.notifications import Listener
from workers.database.statistics import announce_slot
from workers.jobs.claim import Claim, Fenced, cancel_requested, claim_job, input_bytes
from workers.jobs.job_states import say_what_it_waits_for
from workers.process.disk_space import job_disk_budget
from workers.process.exit_status import ExitStatus
from workers.process.waiting import first_done, retry_while_unavailable
from workers.process.watchdog import run_process
from workers.queue.heartbeat import Heartbeat
from workers.queue.janitor import Janitor, release_worker
from workers.run.attempt import Attempt, Ending
from workers.settings.errors import LimitReached, SetupError, Unavailable
from workers.settings.logs import log_context
from workers.settings.settings import Settings
from workers.settings.traces import set_up_traces, span
from workers.store.files import open_files
from workers.store.store_identity import require_same_store

log = logging.getLogger(__name__)

STORE_PATIENCE_S = 180.0  # a job that has run for an hour waits for its store to come back
HOST = platform.node() or "localhost"


class SlotLock:
    """Makes a slot name unique on this host and remembers the queue id of who held it last."""

    def __init__(self, data_dir: Path, name: str) -> None:
        """Take the lock; raises `SetupError` where another process holds it."""
        folder = data_dir / "slots"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{HOST}.{name}"
        self._file: IO[str] = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # freed by the kernel, however we die
        except BlockingIOError:
            raise SetupError(
                "slot_taken", f"Slot {name} runs already on this machine; give this one another --slot."
            ) from None
        self._file.seek(0)
        text = self._file.read().strip()
        self.predecessor = int(text) if text.isdigit() else None

    def remember(self, worker_id: int) -> None:
        """Write down our id for our successor."""
        self._file.truncate(0)
        self._file.write(str(worker_id))
        self._file.flush()


ENDS = {
    "succeeded": ExitStatus.DONE,
    "failed": ExitStatus.JOB_FAILED,
    "cancelled": ExitStatus.JOB_CANCELLED,
    "stopped": ExitStatus.STOPPED,
    "setback": ExitStatus.GIVEN_BACK,
}


class Slot:
    """Takes jobs from the queue and runs them one after the other until it is stopped.

    With ``one_job`` it ends after the first, and with ``idle_exit_s`` where it found none for so long.
    """

    def __init__(
        self, settings: Settings, name: str, *, one_job: bool = False, idle_exit_s: float | None = None
    ) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
            raise SetupError("bad_slot_name", f"--slot {name!r}: letters, digits, - and _ only, at most 40.")
        self._settings, self._name = settings, name
        self._one_job, self._idle_exit_s = one_job, math.inf if idle_exit_s is None else idle_exit_s
        self._files = open_files(settings, patience_s=STORE_PATIENCE_S)
        self._lock = SlotLock(settings.data_dir, name)
        self._scratch = settings.scratch_dir / f"{HOST}.{name}"
        self._stop = asyncio.Event()

    async def run(self) -> ExitStatus:
        """Until SIGTERM or SIGINT. A running job then writes a checkpoint and goes back to the queue."""
        # Left by a predecessor, which the lock shows to be gone.
        shutil.rmtree(self._scratch, ignore_errors=True)
        self._scratch.mkdir(parents=True)
        async with open_database(
            self._settings.require_database_url(),
            connections=5,
            silence_s=self._settings.stall_s,
            answer_s=self._settings.answer_s,
        ) as database:
            if (predecessor := self._lock.predecessor) is not None:
                await retry_while_unavailable(
                    lambda: release_worker(database, predecessor, self._settings.stall_s)
                )
            await require_same_store(database, self._files)
            async with self._registered(database) as worker_id:
                listener = Listener(database, self._settings.poll_s, job_queue.CHANNEL, job_queue.subject_of)
                janitor = Janitor(database, self._files, self._settings)
                side = [asyncio.create_task(listener.run()), asyncio.create_task(janitor.run())]
                try:
                    log.info("slot %s is ready", self._name)
                    return await self._work(database, listener, worker_id)
                finally:
                    for task in side:
                        task.cancel()

    @contextlib.asynccontextmanager
    async def _registered(self, database: Database) -> AsyncIterator[int]:
        """This slot's id as a worker of the queue, which sends heartbeats until the end."""
        worker_id = await retry_while_unavailable(lambda: database.run(job_queue.register_worker))
        self._lock.remember(worker_id)
        await retry_while_unavailable(lambda: announce_slot(database, HOST, self._name, worker_id))
        # Time for a second try, on another connection, before a janitor takes the job back.
        in_time_s = self._settings.stall_s / 3
        heartbeat = Heartbeat(database.url, self._settings.beat_s, worker_id, answer_s=in_time_s)
        heartbeat.start()
        try:
            yield worker_id
        finally:
            heartbeat.end()
            with contextlib.suppress(Unavailable):  # then a janitor does it
                await database.run(job_queue.unregister_worker, worker_id)

    async def _work(self, database: Database, listener: Listener, worker_id: int) -> ExitStatus:
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, self._stop.set)
        idle_from = time.monotonic()
        with listener.waiting(job_queue.NEW_ENTRY) as added:
            while not self._stop.is_set():
                added.clear()
                try:
                    entry = await database.run(job_queue.take, worker_id)
                except Unavailable as error:
                    log.warning("the queue cannot be read: %s", error)
                    entry, idle_from = None, time.monotonic()  # nobody knows whether there is work
                if entry is not None:
                    ending = await self._work_on(database, listener, entry, worker_id)
                    if self._one_job and ending is not None:
                        return ENDS[ending.how]
                    idle_from = time.monotonic()
                    continue
                left_s = idle_from + self._idle_exit_s - time.monotonic()
                if left_s <= 0:
                    break
                pause_s = min(self._settings.poll_s, left_s)
                await first_done(added.wait(), self._stop.wait(), asyncio.sleep(pause_s))
        return ExitStatus.NO_JOB if self._one_job else ExitStatus.DONE

    async def _work_on(
        self, database: Database, listener: Listener, entry: Entry, worker_id: int
    ) -> Ending | None:
        """How the attempt ended; none where there was nothing to run."""
        with log_context(job_id=entry.job_id):
            try:
                ending = await self._run_job(database, listener, entry)
            except Fenced as fenced:
                log.warning("%s; exiting", fenced)
                os._exit(ExitStatus.FENCED)  # its queue entry belongs to the new owner
            except Exception:  # our own failure must not end the slot
                log.exception("the job goes back to the queue")
                ending = Ending("setback", self._settings.stall_s / 4)
            acknowledge = partial(job_queue.acknowledge, again_in_s=ending.again_in_s if ending else None)
            if not await retry_while_unavailable(lambda: database.run(acknowledge, entry.id, worker_id)):
                log.warning("queue entry %d now belongs to another worker", entry.id)
            return ending

    async def _run_job(self, database: Database, listener: Listener, entry: Entry) -> Ending | None:
        if not await self._fits_on_disk(database, entry.job_id):
            say = partial(say_what_it_waits_for, job_id=entry.job_id, cause="disk_full")
            await retry_while_unavailable(lambda: database.run(say))
            return Ending("setback", self._settings.stall_s / 4)
        claim = await claim_job(database, entry.job_id, self._settings.max_attempts, self._settings.stall_s)
        if claim is None:
            return None
        log.info("attempt %s begins", claim.name)
        folder = self._scratch / f"{entry.job_id}-{claim.name}"
        attempt = Attempt(database, self._files, self._settings, claim, folder, self._variables())
        watching = asyncio.create_task(self._stop_when_asked(database, listener, entry, attempt))
        try:
            return await self._traced(attempt, claim)
        finally:
            watching.cancel()

    async def _stop_when_asked(
        self, database: Database, listener: Listener, entry: Entry, attempt: Attempt
    ) -> None:
        """Stop the attempt when its job is cancelled, or when this slot is stopped."""
        with listener.waiting(str(entry.id)) as changed:
            while True:
                changed.clear()
                if self._stop.is_set():
                    attempt.ask_stop("shutdown")
                with contextlib.suppress(Unavailable):
                    if await cancel_requested(database, entry.job_id):
                        attempt.ask_stop("cancel")
                        return
                stopped = [] if self._stop.is_set() else [self._stop.wait()]
                await first_done(changed.wait(), asyncio.sleep(self._settings.poll_s), *stopped)

    async def _fits_on_disk(self, database: Database, job_id: str) -> bool:
        """Whether the job's files fit on the local disk. If not, the job waits for space here or on another host."""
        size = await retry_while_unavailable(lambda: input_bytes(database, job_id))
        try:
            job_disk_budget(self._settings).require(size)
        except LimitReached as full:
            log.warning("the job waits for disk space: %s", full.detail)
            return False
        return True

    async def _traced(self, attempt: Attempt, claim: Claim) -> Ending:
        """Run the attempt, as part of the trace of its submission."""
        if self._settings.traces == "off":
            return await attempt.run()
        about_it: dict[str, str | int] = {"job": claim.job_id, "number": claim.attempt}
        with span("attempt", parent=claim.trace, about=about_it):
            return await attempt.run()

    def _variables(self) -> Mapping[str, str]:
        """Which device and how many cores the job of this slot may use."""
        variables = {"PYTHONUNBUFFERED": "1"}
        gpu = re.fullmatch(r"gpu(\d+)", self._name)
        if gpu:
            variables["CUDA_VISIBLE_DEVICES"] = gpu[1]
        if self._settings.slots > 1 and "OMP_NUM_THREADS" not in os.environ:
            share = max(1, (os.cpu_count() or 1) // self._settings.slots)
            variables |= {"OMP_NUM_THREADS": str(share), "NUMBA_NUM_THREADS": str(share)}
        return variables


def main() -> int:
    """`python -m workers.queue.slot --slot NAME`, settings from the environment."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--slot", default="cpu0")
    parser.add_argument("--one-job", action="store_true")
    parser.add_argument("--idle-exit", type=float, metavar="S")
    given = parser.parse_args()

    async def work(settings: Settings) -> ExitStatus:
        set_up_traces(given.slot, settings)
        slot = Slot(settings, given.slot, one_job=given.one_job, idle_exit_s=given.idle_exit)
        return await slot.run()

    return run_process(given.slot, work)


if __name__ == "__main__":
    sys.exit(main())

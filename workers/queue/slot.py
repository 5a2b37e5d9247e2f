"""A slot: a small process that runs one refinement at a time, and exports beside it. Loads no torch, no numpy."""

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
from collections.abc import AsyncIterator, Coroutine, Mapping
from itertools import count
from pathlib import Path
from typing import IO, Literal, TypeVar

from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.database.job_queue import EXPORTS, REFINEMENTS
from workers.database.notifications import Listener
from workers.database.statistics import announce_slot
from workers.process.exit_status import ExitStatus
from workers.process.waiting import first_done, retry_while_unavailable
from workers.process.watchdog import end_if_broken, run_process
from workers.queue.heartbeat import Heartbeat
from workers.queue.janitor import Janitor, release_worker
from workers.queue.lane import Lane, Workplace
from workers.settings.errors import SetupError, Unavailable
from workers.settings.settings import Settings
from workers.settings.traces import set_up_traces
from workers.store.files import open_files
from workers.store.store_identity import require_same_store

log = logging.getLogger(__name__)

STORE_PATIENCE_S = 180.0  # after an hour of work, a job waits for its store to recover
T = TypeVar("T")

ENDS = {
    "succeeded": ExitStatus.DONE,
    "split": ExitStatus.DONE,
    "failed": ExitStatus.JOB_FAILED,
    "cancelled": ExitStatus.JOB_CANCELLED,
    "stopped": ExitStatus.STOPPED,
    "setback": ExitStatus.GIVEN_BACK,
}


HOST = platform.node() or "localhost"


class SlotLock:
    """Makes a slot name unique on this host and remembers the queue id of its last holder."""

    def __init__(self, data_dir: Path, name: str) -> None:
        """Take the lock; raises `SetupError` (``bad_slot_name``; ``slot_taken`` if another process holds it)."""
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
            raise SetupError("bad_slot_name", f"--slot {name!r}: letters, digits, - and _ only, at most 40.")
        self.name = name
        folder = data_dir / "slots"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{HOST}.{name}"
        self._file: IO[str] = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the kernel, however we die
        except BlockingIOError:
            self._file.close()
            raise SetupError(
                "slot_taken", f"Slot {name} runs already on this machine; give this one another --slot."
            ) from None
        self._file.seek(0)
        text = self._file.read().strip()
        self.predecessor = int(text) if text.isdigit() else None

    def remember(self, worker_id: int) -> None:
        """Store our id for our successor."""
        self._file.truncate(0)
        self._file.write(str(worker_id))
        self._file.flush()


def lock_free_slot(data_dir: Path, kind: Literal["cpu", "gpu"]) -> SlotLock:
    """Lock the first free one of ``cpu0``, ``cpu1`` …, so that short-lived workers reuse names."""
    for number in count():
        try:
            return SlotLock(data_dir, f"{kind}{number}")
        except SetupError as taken:
            if taken.code != "slot_taken":
                raise
    raise AssertionError("numbers do not end")


class Slot:
    """Takes jobs from the queue until it is stopped: refinements one after the other, and exports beside them.

    Ends after the first with ``one_job``, and after ``idle_exit_s`` without any. ``gpu`` is the device of its jobs; if
    None, the environment decides.
    """

    def __init__(
        self,
        settings: Settings,
        lock: SlotLock,
        *,
        gpu: str | None = None,
        one_job: bool = False,
        idle_exit_s: float | None = None,
    ) -> None:
        self._settings, self._lock, self._name, self._gpu = settings, lock, lock.name, gpu
        self._one_job, self._idle_exit_s = one_job, math.inf if idle_exit_s is None else idle_exit_s
        self._files = open_files(settings, patience_s=STORE_PATIENCE_S)
        self._scratch = settings.scratch_dir / f"{HOST}.{lock.name}"
        self._stop = asyncio.Event()

    async def run(self) -> ExitStatus:
        """Run until SIGTERM or SIGINT. A running job then writes a checkpoint and goes back to the queue."""
        # Left by a predecessor, which is dead, since we hold the lock.
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
            async with end_if_broken(database.broken), self._registered(database) as worker_id:
                listener = Listener(
                    database, self._settings.poll_s, *job_queue.CHANNELS, subject_of=job_queue.subject_of
                )
                janitor = Janitor(database, self._files, self._settings)
                side = [asyncio.create_task(listener.run()), asyncio.create_task(janitor.run())]
                try:
                    log.info("slot %s is ready", self._name)
                    place = Workplace(
                        *(database, self._files, listener, self._settings, worker_id),
                        *(self._scratch, self._variables(), self._stop),
                    )
                    return await self._work(place)
                finally:
                    for task in side:
                        task.cancel()

    @contextlib.asynccontextmanager
    async def _registered(self, database: Database) -> AsyncIterator[int]:
        """This slot's id as a worker of the queue, which sends heartbeats until the end."""
        worker_id = await retry_while_unavailable(lambda: database.run(job_queue.register_worker))
        self._lock.remember(worker_id)
        await retry_while_unavailable(lambda: announce_slot(database, HOST, self._name, worker_id))
        # Leaves time for a retry, on a new connection, before a janitor takes the job back.
        in_time_s = self._settings.stall_s / 3
        heartbeat = Heartbeat(database.url, self._settings.beat_s, worker_id, answer_s=in_time_s)
        heartbeat.start()
        try:
            yield worker_id
        finally:
            heartbeat.end()
            with contextlib.suppress(Unavailable):  # then a janitor does it
                await database.run(job_queue.unregister_worker, worker_id)

    async def _work(self, place: Workplace) -> ExitStatus:
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, place.stop.set)
        if self._one_job:
            return await self._work_on_one(place)
        refinements = Lane(place, (REFINEMENTS,))
        await self._exporting(place, refinements.run(asyncio.Event(), self._idle_exit_s))
        return ExitStatus.DONE

    async def _work_on_one(self, place: Workplace) -> ExitStatus:
        lane, never = Lane(place, job_queue.KINDS), asyncio.Event()
        while (entry := await lane.next(never, self._idle_exit_s)) is not None:
            work = lane.work_on(entry)
            ending = await (work if entry.kind == EXPORTS else self._exporting(place, work))
            if ending is not None:
                return ENDS[ending.how]
        return ExitStatus.NO_JOB

    async def _exporting(self, place: Workplace, work: Coroutine[None, None, T]) -> T:
        """The result of ``work``, with exports run beside it: they take seconds, it may take hours."""
        over = asyncio.Event()
        working = asyncio.create_task(work)
        exporting = asyncio.create_task(Lane(place, (EXPORTS,)).run(over))
        try:
            await first_done(working, exporting)
            over.set()
            await asyncio.gather(working, exporting)
            return working.result()
        finally:
            working.cancel()
            exporting.cancel()

    def _variables(self) -> Mapping[str, str]:
        """Environment variables for the device and the cores that this slot's jobs may use."""
        variables = {"PYTHONUNBUFFERED": "1"}
        if self._gpu is not None:
            variables["CUDA_VISIBLE_DEVICES"] = self._gpu
        if self._settings.slots > 1 and "OMP_NUM_THREADS" not in os.environ:
            share = max(1, (os.cpu_count() or 1) // self._settings.slots)
            variables |= {"OMP_NUM_THREADS": str(share), "NUMBA_NUM_THREADS": str(share)}
        return variables


def run_slot(
    slot: str,
    free_slot: Literal["cpu", "gpu"] | None = None,
    *,
    one_job: bool = False,
    idle_exit_s: float | None = None,
) -> ExitStatus:
    """Run the slot of that name, or the first free one of a kind, with the settings of the environment; see `Slot`."""

    async def work(settings: Settings) -> ExitStatus:
        lock = (
            SlotLock(settings.data_dir, slot)
            if free_slot is None
            else lock_free_slot(settings.data_dir, free_slot)
        )
        set_up_traces(lock.name, settings)
        gpu = re.fullmatch(r"gpu(\d+)", lock.name)
        # A batch system has chosen the process's device; the free slot's number is not the GPU's.
        given_device = free_slot is not None and "CUDA_VISIBLE_DEVICES" in os.environ
        device = gpu[1] if gpu and not given_device else None
        return await Slot(settings, lock, gpu=device, one_job=one_job, idle_exit_s=idle_exit_s).run()

    return run_process(free_slot or slot, work)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="One slot, settings from the environment.")
    parser.add_argument("--slot", default="cpu0")
    sys.exit(run_slot(parser.parse_args().slot))

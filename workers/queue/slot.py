"""A slot: a small process that runs one job at a time, each in a child process. Loads no torch, no numpy."""

from __future__ import annotations

import argparse
import asyncio
import fcntl
import logging
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, TypeVar

from procrastinate import BaseRetryStrategy, JobContext, RetryDecision
from procrastinate.exceptions import ConnectorException
from procrastinate.job_context import AbortReason
from procrastinate.jobs import Job

from workers.database.database import QUEUE, TASK, Database, first_line, open_database
from workers.database.statistics import announce_slot
from workers.process.disk_space import room_for_jobs
from workers.process.watchdog import watched
from workers.queue.fenced_worker import FencedWorker
from workers.queue.heartbeat import Beat
from workers.queue.janitor import Janitor, release_worker
from workers.run.attempt import Attempt
from workers.run.claim import Claim, Fenced, claim_job, insist
from workers.settings.errors import LimitReached, SetupError
from workers.settings.logs import about, set_up_logging
from workers.settings.settings import Settings
from workers.settings.traces import set_up_traces, span
from workers.store.files import open_files
from workers.store.store_identity import require_same_store

log = logging.getLogger(__name__)

EXIT_FENCED = 75
NEVER_S = 10 * 365 * 86_400.0
STORE_PATIENCE_S = 180.0  # a job that has run for an hour waits for its store to come back
T = TypeVar("T")


class BackToQueue(Exception):
    """Tells the queue engine to offer the job again, after some seconds."""

    def __init__(self, after_s: float = 0) -> None:
        super().__init__(after_s)
        self.after_s = after_s


class OfferAgain(BaseRetryStrategy):
    """No cap on the engine's side: attempts are counted in the job, where shutdowns do not count."""

    def get_retry_decision(self, *, exception: BaseException, job: Job) -> RetryDecision:
        """At once, unless the job was sent back to wait."""
        wait_s = exception.after_s if isinstance(exception, BackToQueue) else 0
        return RetryDecision(retry_at=datetime.now(UTC) + timedelta(seconds=wait_s))


class SlotLock:
    """Makes a slot name unique on this host and remembers the queue id of who held it last."""

    def __init__(self, data_dir: Path, name: str) -> None:
        """Take the lock; raises `SetupError` where another process holds it."""
        folder = data_dir / "slots"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{platform.node() or 'localhost'}.{name}"
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


class Slot:
    """Claims jobs from the queue and runs them one after the other until told to stop."""

    def __init__(self, settings: Settings, name: str) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
            raise SetupError("bad_slot_name", f"--slot {name!r}: letters, digits, - and _ only, at most 40.")
        self._settings, self._name = settings, name
        self._files = open_files(settings, patience_s=STORE_PATIENCE_S)
        self._lock = SlotLock(settings.data_dir, name)
        self._scratch = settings.scratch_dir / f"{platform.node() or 'localhost'}.{name}"
        self._running: set[int] = set()
        self._worker: FencedWorker | None = None

    async def run(self) -> None:
        """Until SIGTERM or SIGINT. A running job then writes a checkpoint and goes back to the queue."""
        shutil.rmtree(self._scratch, ignore_errors=True)  # a predecessor's; the lock says it is gone
        self._scratch.mkdir(parents=True)
        async with (
            watched(),
            open_database(
                self._settings.require_database_url(),
                connections=5,
                silence_s=self._settings.stall_s,
                answer_s=self._settings.answer_s,
            ) as database,
        ):
            if (predecessor := self._lock.predecessor) is not None:
                await insist(lambda: release_worker(database, predecessor))
            await require_same_store(database, self._files)
            self._register(database)
            worker = self._worker = FencedWorker(
                database,
                queues=[QUEUE],
                name=self._name,
                concurrency=1,
                shutdown_graceful_timeout=0.1,  # the attempt writes its checkpoint after this, see `_relay`
                update_heartbeat_interval=NEVER_S,  # see Beat
                # It would prune living workers at our start, right after an outage; see Janitor.
                stalled_worker_timeout=NEVER_S,
                fetch_job_polling_interval=self._settings.poll_s,
                abort_job_polling_interval=self._settings.poll_s,
            )
            # Time for a second try, on another connection, before anybody takes us for dead.
            in_time_s = self._settings.stall_s / 3
            beat = Beat(database.url, self._settings.beat_s, self._worker_id, answer_s=in_time_s)
            beat.start()
            janitor = Janitor(database, self._files, self._settings, self._worker_id, self._running)
            side = [asyncio.create_task(janitor.run()), asyncio.create_task(self._remember(database))]
            try:
                log.info("slot %s is ready", self._name)
                await worker.run()
            finally:
                beat.end()
                for task in side:
                    task.cancel()

    def _worker_id(self) -> int | None:
        return self._worker.worker_id if self._worker is not None else None

    async def _remember(self, database: Database) -> None:
        while (worker_id := self._worker_id()) is None:
            await asyncio.sleep(0.01)
        self._lock.remember(worker_id)
        host = platform.node() or "localhost"
        await insist(lambda: announce_slot(database, host, self._name, worker_id))

    def _register(self, database: Database) -> None:
        @database.app.task(name=TASK, queue=QUEUE, pass_context=True, retry=OfferAgain())
        async def refine(context: JobContext, job_id: str) -> None:
            queue_id = context.job.id
            assert queue_id is not None, "fetched from the database"
            self._running.add(queue_id)
            try:
                with about(job_id=job_id):
                    if not await _relay(asyncio.create_task(self._has_room(database, job_id)), lambda: None):
                        raise BackToQueue(self._settings.stall_s / 4)
                    again = await self._run_job(database, context, job_id)
            except Fenced as fenced:
                log.warning("%s; leaving", fenced)
                # Without a word to the queue: its row belongs to the new owner.
                os._exit(EXIT_FENCED)
            finally:
                self._running.discard(queue_id)
            if again:
                raise BackToQueue

    async def _has_room(self, database: Database, job_id: str) -> bool:
        """Whether the job's files fit on the local disk; where not, another host may have room now, or we later."""
        rows = await insist(
            lambda: database.fetch(
                "SELECT sum(file.size)::bigint AS bytes FROM jobs"
                " JOIN dataset_files AS file ON file.dataset_id = jobs.dataset_id WHERE jobs.id = %s",
                job_id,
            )
        )
        try:
            room_for_jobs(self._settings).require(rows[0]["bytes"] or 0)
        except LimitReached as full:
            log.warning("the job waits: %s", full.detail)
            return False
        return True

    async def _run_job(self, database: Database, context: JobContext, job_id: str) -> bool:
        claiming = asyncio.create_task(claim_job(database, job_id, self._settings.max_attempts))
        stopped: list[str] = []
        claim = await _relay(claiming, lambda: stopped.append("early"))
        if claim is None:
            return False
        log.info("attempt %s begins", claim.name)
        folder = self._scratch / f"{job_id}-{claim.name}"
        attempt = Attempt(database, self._files, self._settings, claim, folder, self._variables())

        def ask_stop() -> None:
            cancelled = context.abort_reason() == AbortReason.USER_REQUEST
            attempt.ask_stop("cancel" if cancelled else "shutdown")

        if stopped:
            ask_stop()
        return await _relay(asyncio.create_task(self._traced(database, attempt, claim)), ask_stop)

    async def _traced(self, database: Database, attempt: Attempt, claim: Claim) -> bool:
        """The attempt, as part of the trace of its submission."""
        if self._settings.traces == "off":
            return await attempt.run()
        rows = await insist(lambda: database.fetch("SELECT trace FROM jobs WHERE id = %s", claim.job_id))
        about_it: dict[str, str | int] = {"job": claim.job_id, "number": claim.attempt}
        with span("attempt", parent=rows[0]["trace"] if rows else None, about=about_it):
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


async def _relay(work: asyncio.Task[T], on_cancel: Callable[[], object]) -> T:
    """Await ``work`` to its end, turning each cancellation of us into a call of ``on_cancel``.

    The queue engine cancels its task both for a user's wish and for a shutdown, and may do so twice. The work
    has a database to write to and must not be torn at any await.
    """
    while True:
        try:
            return await asyncio.shield(work)
        except asyncio.CancelledError:
            if work.cancelled():
                raise
            on_cancel()


def main() -> int:
    """`python -m workers.queue.slot --slot NAME`, settings from the environment."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--slot", default="cpu0")
    arguments = parser.parse_args()
    settings = Settings()
    set_up_logging(arguments.slot, settings)
    logging.getLogger("procrastinate").setLevel(logging.CRITICAL)  # outcomes are in the job's own history
    try:
        set_up_traces(arguments.slot, settings)
        asyncio.run(Slot(settings, arguments.slot).run())
    except SetupError as error:
        sys.stderr.write(f"{error.detail}\n")
        return 2
    except ConnectorException as error:
        # Only while idle; the supervisor starts us again, and until the database is back there is no work.
        log.error("lost the database: %s", first_line(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Keeps the processes of one machine running: the private database, if any, and the given commands."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field

from workers.database.database import open_database
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.process.die_with_parent import dying_with_parent
from workers.process.waiting import first_done
from workers.queue.janitor import release_worker
from workers.settings.errors import SetupError
from workers.settings.settings import Settings
from workers.settings.settings_files import environment_with

log = logging.getLogger(__name__)

FIRST_PAUSE_S = 0.2
LONGEST_PAUSE_S = 10.0
# A process that died sooner in each of so many starts has a fault that a restart will not fix.
SETTLED_S = 5.0
STARTS_MAX = 5
KILL_AFTER_S = 5.0


@dataclass(frozen=True)
class ChildSpec:
    """A process to keep running.

    Attributes:
        stop_grace_s: how long it may take to end after SIGTERM.
        descriptors: open files that it inherits, under the same numbers.
    """

    name: str
    command: Sequence[str]
    variables: Mapping[str, str] = field(default_factory=dict)
    stop_grace_s: float = 10.0
    descriptors: tuple[int, ...] = ()


def slot_specs(settings: Settings) -> list[ChildSpec]:
    """One worker process for each slot of this machine: ``gpuN`` where CUDA_VISIBLE_DEVICES names GPUs."""
    gpus = [part for part in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if part.strip().isdigit()]
    names = [f"gpu{gpus[i]}" if i < len(gpus) else f"cpu{i}" for i in range(settings.slots)]
    return [
        ChildSpec(
            name,
            (sys.executable, "-m", "workers.queue.slot", "--slot", name),
            stop_grace_s=settings.stop_grace_s + KILL_AFTER_S,
        )
        for name in names
    ]


def dispatcher_spec(settings: Settings) -> ChildSpec:
    """The process that sends webhooks and fetches files; on SIGTERM it finishes what it is sending."""
    grace_s = settings.webhook_timeout_s + KILL_AFTER_S
    return ChildSpec("dispatcher", (sys.executable, "-m", "workers.upkeep.dispatcher"), stop_grace_s=grace_s)


async def supervise(
    settings: Settings,
    children: Sequence[ChildSpec],
    *,
    on_ready: Callable[[str], Coroutine[None, None, None]] | None = None,
) -> int:
    """Run database and children until SIGTERM or SIGINT; returns the exit status (1: a child is broken).

    Without ``settings.database_url`` a private PostgreSQL is started first. The database is migrated, and
    children find its address in BIRESNERF_DATABASE_URL. Every child is restarted when it ends, with growing
    pauses, and dies with this process. ``on_ready`` gets the database's address once all have started.

    Raises `SetupError` if the database cannot be started or migrated.
    """
    postgres = None
    if settings.database_url is None:
        postgres = EmbeddedPostgres(
            settings.postgres_dir, pg_bin=settings.pg_bin, connections=_connections(settings)
        )
        postgres.start()
    try:
        url = postgres.url if postgres is not None else settings.require_database_url()
        migrate(url)
        if postgres is not None:
            # We hold the folder's lock, and all workers died with our predecessor, so no job is running.
            async with open_database(url, connections=1) as database:
                await release_worker(database, None, settings.stall_s)
        return await _Supervisor(settings, url, postgres, children).run(on_ready)
    finally:
        if postgres is not None:
            postgres.stop()


async def keep_running(settings: Settings, children: Sequence[ChildSpec]) -> int:
    """The same for children alone, with an existing, migrated database."""
    return await _Supervisor(settings, settings.require_database_url(), None, children).run(None)


def _connections(settings: Settings) -> int:
    """Enough connections for all processes of this machine and the operator's commands."""
    return max(100, 20 + 10 * settings.processes + 8 * settings.slots)


class _Supervisor:
    def __init__(
        self, settings: Settings, url: str, postgres: EmbeddedPostgres | None, children: Sequence[ChildSpec]
    ) -> None:
        self._postgres, self._children = postgres, children
        self._environment = environment_with(
            {
                "BIRESNERF_DATABASE_URL": url,
                "BIRESNERF_DATA_DIR": str(settings.data_dir.absolute()),
                "BIRESNERF_SLOTS": str(settings.slots),
            }
        )
        self._stop = asyncio.Event()
        self._now = asyncio.Event()
        self._status = 0

    async def run(self, on_ready: Callable[[str], Coroutine[None, None, None]] | None) -> int:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._asked_to_stop)
        keeping = [asyncio.create_task(self._keep(spec)) for spec in self._children]
        database = asyncio.create_task(self._keep_database())
        url = self._environment["BIRESNERF_DATABASE_URL"]
        ready = asyncio.create_task(on_ready(url)) if on_ready is not None else None
        try:
            await asyncio.gather(*keeping)  # children end after `_stop`, while the database still answers
            await self._stop.wait()
        finally:
            self._stop.set()
            await asyncio.gather(*keeping, return_exceptions=True)
            database.cancel()
            if ready is not None:
                ready.cancel()
            for number in (signal.SIGTERM, signal.SIGINT):
                loop.remove_signal_handler(number)
        return self._status

    def _asked_to_stop(self) -> None:
        if self._stop.is_set():
            self._now.set()  # kill at the second signal
        self._stop.set()

    async def _keep(self, spec: ChildSpec) -> None:
        pause_s, starts, settled = FIRST_PAUSE_S, 0, False
        while not self._stop.is_set():
            try:
                process = await asyncio.create_subprocess_exec(
                    *dying_with_parent(list(spec.command), signal_number=signal.SIGKILL),
                    stdin=asyncio.subprocess.DEVNULL,
                    env={**self._environment, **spec.variables},
                    start_new_session=True,
                    pass_fds=spec.descriptors,
                )
            except OSError as error:  # temporary: too many processes, or no memory for one more
                log.error("%s cannot be started (%s); again in %.1f s", spec.name, error, LONGEST_PAUSE_S)
                await first_done(asyncio.sleep(LONGEST_PAUSE_S), self._stop.wait())
                continue
            began, starts = time.monotonic(), starts + 1
            ended = asyncio.create_task(process.wait())
            try:
                await first_done(ended, self._stop.wait())
                if self._stop.is_set():
                    await self._end(process, ended, spec.stop_grace_s)
                    return
            finally:
                if process.returncode is None:
                    _signal_group(process.pid, signal.SIGKILL)
            lived_s = time.monotonic() - began
            settled = settled or lived_s >= SETTLED_S
            if not settled and starts >= STARTS_MAX:
                self._status = 1
                self._stop.set()
                log.error("%s ended %d times right after its start; giving up", spec.name, starts)
                return
            pause_s = FIRST_PAUSE_S if lived_s >= SETTLED_S else min(2 * pause_s, LONGEST_PAUSE_S)
            log.warning("%s ended with status %s; again in %.1f s", spec.name, process.returncode, pause_s)
            await first_done(asyncio.sleep(pause_s), self._stop.wait())

    async def _end(
        self, process: asyncio.subprocess.Process, ended: asyncio.Task[int], grace_s: float
    ) -> None:
        _signal_group(process.pid, signal.SIGTERM, group=False)
        await first_done(ended, asyncio.sleep(grace_s), self._now.wait())
        if not ended.done():
            log.warning("process %d did not end in time; killing it", process.pid)
            _signal_group(process.pid, signal.SIGKILL)
        await ended

    async def _keep_database(self) -> None:
        """Start the private database again when it dies; children reconnect by themselves."""
        pause_s = FIRST_PAUSE_S
        while self._postgres is not None:
            await asyncio.sleep(0.2)
            if self._postgres.alive:
                continue
            log.warning("the private database ended; starting it again")
            try:
                self._postgres.start()
                pause_s = FIRST_PAUSE_S
            except SetupError as error:
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
                log.error("%s", error.detail)
                await asyncio.sleep(pause_s)


def _signal_group(pid: int, number: signal.Signals, *, group: bool = True) -> None:
    with contextlib.suppress(ProcessLookupError):
        (os.killpg if group else os.kill)(pid, number)

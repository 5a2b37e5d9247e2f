"""Random faults: processes are killed, frozen and terminated, the database is restarted and frozen.

With real jobs also: a full disk, a store that refuses or hangs, and a clock an hour off.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable

from benchmarks.chaos.installation import Installation, Kept
from benchmarks.chaos.surroundings import Surroundings


class Faults:
    """Injects faults into an installation, one after the other; `done` counts them by name."""

    def __init__(self, installation: Installation, chance: random.Random, every_s: float) -> None:
        self._installation, self._chance, self._every_s = installation, chance, every_s
        self.done: Counter[str] = Counter()
        self._under_way: set[asyncio.Task[None]] = set()

    async def run(self, until: asyncio.Event) -> None:
        """Inject faults until the event, then wait until all are over."""
        deck: list[Callable[[], Awaitable[None]]] = []
        while not until.is_set():
            deck = deck or self._shuffled()
            task = asyncio.create_task(self._do(deck.pop()))
            self._under_way.add(task)
            task.add_done_callback(self._under_way.discard)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(until.wait(), self._chance.uniform(0.5, 1.5) * self._every_s)
        await asyncio.gather(*self._under_way)

    def _shuffled(self) -> list[Callable[[], Awaitable[None]]]:
        """Each kind once, so that even a short run has all of them."""
        deck = [
            *(self._kill_worker, self._freeze_worker, self._end_worker, self._kill_job, self._freeze_worker),
            *(self._kill_api, self._end_api, self._freeze_api),
            *(self._restart_database, self._crash_database, self._freeze_database),
        ]
        if self._installation.around is not None:
            deck += [self._fill_disk, self._cut_store, self._silence_store, self._move_clock]
        self._chance.shuffle(deck)
        return deck

    async def _do(self, fault: Callable[[], Awaitable[None]]) -> None:
        self.done[fault.__name__.strip("_").replace("_", " ")] += 1
        await fault()

    async def _kill_worker(self) -> None:
        _signal([self._one(self._installation.workers)], signal.SIGKILL)

    async def _end_worker(self) -> None:
        _signal([self._one(self._installation.workers)], signal.SIGTERM)

    async def _freeze_worker(self) -> None:
        stall_s = self._installation.settings.stall_s
        await _freeze([self._one(self._installation.workers)], self._chance.uniform(0.2, 2.0) * stall_s)

    async def _kill_job(self) -> None:
        running = self._installation.job_processes()
        _signal([self._chance.choice(running) if running else None], signal.SIGKILL)

    async def _kill_api(self) -> None:
        _signal([self._one(self._installation.replicas)], signal.SIGKILL)

    async def _end_api(self) -> None:
        _signal([self._one(self._installation.replicas)], signal.SIGTERM)

    async def _freeze_api(self) -> None:
        stall_s = self._installation.settings.stall_s
        await _freeze([self._one(self._installation.replicas)], self._chance.uniform(0.2, 1.5) * stall_s)

    async def _restart_database(self) -> None:
        await self._database_away(signal.SIGINT, self._chance.uniform(0, 2.0))

    async def _crash_database(self) -> None:
        await self._database_away(signal.SIGKILL, self._chance.uniform(0, 2.0))

    async def _freeze_database(self) -> None:
        stall_s = self._installation.settings.stall_s
        await _freeze(self._installation.database_processes(), self._chance.uniform(0.2, 1.5) * stall_s)

    @property
    def _around(self) -> Surroundings:
        assert self._installation.around is not None, "asked only where jobs are real"
        return self._installation.around

    async def _fill_disk(self) -> None:
        await self._around.disk.fill(self._chance.uniform(0.5, 1.5) * self._installation.settings.stall_s)

    async def _cut_store(self) -> None:
        await self._around.store.refuse(self._chance.uniform(0.2, 1.0) * self._installation.settings.stall_s)

    async def _silence_store(self) -> None:
        stall_s = self._installation.settings.stall_s
        await self._around.store.fall_silent(self._chance.uniform(0.2, 1.0) * stall_s)

    async def _move_clock(self) -> None:
        self._around.clock.jump(self._chance.choice((3600, -3600, 0)))

    async def _database_away(self, number: signal.Signals, away_s: float) -> None:
        postgres = self._installation.postgres
        if not postgres.alive:
            return
        assert postgres.process is not None, "alive"
        for frozen in self._installation.database_processes():
            _signal([frozen], signal.SIGCONT)
        postgres.process.send_signal(number)
        while postgres.alive:
            await asyncio.sleep(0.05)
        await asyncio.sleep(away_s)
        postgres.start()  # in this thread: the server dies with it

    def _one(self, kept: list[Kept]) -> int | None:
        return self._chance.choice(kept).pid


async def _freeze(pids: Iterable[int | None], seconds: float) -> None:
    pids = list(pids)
    _signal(pids, signal.SIGSTOP)
    await asyncio.sleep(seconds)
    _signal(pids, signal.SIGCONT)


def _signal(pids: Iterable[int | None], number: signal.Signals) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            if pid is not None:
                os.kill(pid, number)

"""Runs an engine process, and ends one whose event loop hangs: only a process that ended is started again."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import logging
import os
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

from workers.process.exit_status import ExitStatus
from workers.settings.errors import SetupError
from workers.settings.logs import set_up_logging
from workers.settings.settings import Settings

log = logging.getLogger(__name__)

# Long for anything that a loop of ours does in one step; a file system that hangs takes longer.
STUCK_S = 60.0
LOOKS = 10


@contextlib.asynccontextmanager
async def end_if_hung(stuck_s: float = STUCK_S, beat: Path | None = None) -> AsyncIterator[None]:
    """While inside, the process ends with `ExitStatus.STUCK` where this event loop does nothing for ``stuck_s``.

    The loop touches the file ``beat`` all the while: deploy/health.py goes by its age, where a library that keeps
    Python's lock holds up our thread as well.
    """
    watchdog = _Watchdog(stuck_s / LOOKS, beat)
    watchdog.start()
    ticking = asyncio.create_task(watchdog.tick())
    try:
        yield
    finally:
        watchdog.end.set()
        ticking.cancel()


@contextlib.asynccontextmanager
async def end_if_broken(broken: asyncio.Event) -> AsyncIterator[None]:
    """While inside, the process ends with `ExitStatus.STUCK` once ``broken`` is set, which nothing else mends."""

    async def end() -> None:
        await broken.wait()
        log.critical("the process cannot go on; exiting")
        os._exit(ExitStatus.STUCK)

    waiting = asyncio.create_task(end())
    try:
        yield
    finally:
        waiting.cancel()


def run_process(name: str, work: Callable[[Settings], Awaitable[ExitStatus]]) -> ExitStatus:
    """Run ``work``, which tells the exit status, with the settings of the environment."""
    settings = Settings()
    set_up_logging(name, settings)

    async def watched() -> ExitStatus:
        async with end_if_hung(beat=settings.data_dir / "beats" / f"{os.uname().nodename}.{name}"):
            return await work(settings)

    try:
        return asyncio.run(watched())
    except SetupError as error:
        sys.stderr.write(f"{error.detail}\n")
        return ExitStatus.SETUP


class _Watchdog(threading.Thread):
    def __init__(self, period_s: float, beat: Path | None) -> None:
        super().__init__(daemon=True, name="watchdog")
        self._beat = beat
        self.end = threading.Event()
        self._period_s, self._ticks = period_s, 0

    async def tick(self) -> None:
        """Show that the loop goes on."""
        while True:
            self._ticks += 1
            self._show()
            await asyncio.sleep(self._period_s / 2)

    def _show(self) -> None:
        if self._beat is not None:
            with contextlib.suppress(OSError):  # a full disk is no reason to end
                self._beat.parent.mkdir(parents=True, exist_ok=True)
                self._beat.touch()

    def run(self) -> None:
        """Check until `end` is set."""
        # Looks are counted, not seconds: of a process that was frozen as a whole, this thread was frozen too.
        seen, in_vain = -1, 0
        while not self.end.wait(self._period_s):
            in_vain = in_vain + 1 if self._ticks == seen else 0
            seen = self._ticks
            if in_vain >= LOOKS:
                log.critical("the event loop is blocked; exiting")
                faulthandler.dump_traceback(all_threads=True)
                os._exit(ExitStatus.STUCK)

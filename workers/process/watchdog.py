"""Runs an engine process, and ends it if its event loop hangs: only ended processes are restarted."""

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

# Far longer than any step of our loops takes; a hanging file system takes longer.
STUCK_S = 60.0
LOOKS = 10


@contextlib.asynccontextmanager
async def end_if_hung(stuck_s: float = STUCK_S, beat: Path | None = None) -> AsyncIterator[None]:
    """Within the context, ends the process with `ExitStatus.STUCK` if this event loop hangs for ``stuck_s``.

    The loop keeps touching the file ``beat``. deploy/health.py checks its age, because a library that holds Python's
    lock blocks our thread as well.
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
    """Within the context, ends the process with `ExitStatus.STUCK` once ``broken`` is set: only a restart helps."""

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
    """Run ``work``, which returns the exit status, with the settings of the environment."""
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
        """Show that the loop is running."""
        while True:
            self._ticks += 1
            self._show()
            await asyncio.sleep(self._period_s / 2)

    def _show(self) -> None:
        if self._beat is not None:
            with contextlib.suppress(OSError):  # a full disk must not end the process
                self._beat.parent.mkdir(parents=True, exist_ok=True)
                self._beat.touch()

    def run(self) -> None:
        """Check until `end` is set."""
        # Counts looks, not seconds: when the whole process is frozen, so is this thread.
        seen, in_vain = -1, 0
        while not self.end.wait(self._period_s):
            in_vain = in_vain + 1 if self._ticks == seen else 0
            seen = self._ticks
            if in_vain >= LOOKS:
                log.critical("the event loop is blocked; exiting")
                faulthandler.dump_traceback(all_threads=True)
                os._exit(ExitStatus.STUCK)

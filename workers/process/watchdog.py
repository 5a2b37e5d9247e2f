"""Ends a process whose event loop hangs: a process that ended is started again, one that hangs is not."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import logging
import os
import threading
from collections.abc import AsyncIterator

log = logging.getLogger(__name__)

EXIT_STUCK = 70
# Long for anything that a loop of ours does in one step; a file system that hangs takes longer.
STUCK_S = 60.0
LOOKS = 10


@contextlib.asynccontextmanager
async def end_if_hung(stuck_s: float = STUCK_S) -> AsyncIterator[None]:
    """While inside, the process ends with `EXIT_STUCK` where this event loop does nothing for ``stuck_s``."""
    watchdog = _Watchdog(stuck_s / LOOKS)
    watchdog.start()
    ticking = asyncio.create_task(watchdog.tick())
    try:
        yield
    finally:
        watchdog.end.set()
        ticking.cancel()


class _Watchdog(threading.Thread):
    def __init__(self, period_s: float) -> None:
        super().__init__(daemon=True, name="watchdog")
        self.end = threading.Event()
        self._period_s, self._ticks = period_s, 0

    async def tick(self) -> None:
        """Show that the loop goes on."""
        while True:
            self._ticks += 1
            await asyncio.sleep(self._period_s / 2)

    def run(self) -> None:
        """Check until `end` is set."""
        # Looks are counted, not seconds: of a process that was frozen as a whole, this thread was frozen too.
        seen, in_vain = -1, 0
        while not self.end.wait(self._period_s):
            in_vain = in_vain + 1 if self._ticks == seen else 0
            seen = self._ticks
            if in_vain >= LOOKS:
                log.critical("the event loop stands still; leaving")
                faulthandler.dump_traceback(all_threads=True)
                os._exit(EXIT_STUCK)

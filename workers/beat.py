"""The worker's sign of life: a thread with a connection of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import psycopg

from workers.database import CONNECT, first_line

log = logging.getLogger(__name__)


class Beat(threading.Thread):
    """Tells the queue every ``period_s`` that worker ``worker_id()`` lives; tries again for ever.

    A thread, because the queue's own beat lives in the event loop, ends when the worker begins to drain, and
    stops the worker when the database is away for half a minute.
    """

    def __init__(self, url: str, period_s: float, worker_id: Callable[[], int | None]) -> None:
        super().__init__(daemon=True, name="beat")
        self._url, self._period_s, self._worker_id = url, period_s, worker_id
        self._end = threading.Event()

    def run(self) -> None:
        """Beat until `end`."""
        connection: psycopg.Connection | None = None
        while not self._end.wait(self._period_s):
            worker_id = self._worker_id()
            if worker_id is None:
                continue
            try:
                if connection is None or connection.closed:
                    connection = psycopg.connect(self._url, autocommit=True, **CONNECT)
                connection.execute("SELECT procrastinate_update_heartbeat_v1(%s)", (worker_id,))
            except psycopg.Error as error:
                log.warning("no sign of life: %s", first_line(error))
                if connection is not None:
                    connection.close()
                connection = None
        if connection is not None:
            connection.close()

    def end(self) -> None:
        """Stop; the last sign of life stays."""
        self._end.set()

"""How many bodies of files a client may be sending at the same time, counted by each web process alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from service.http.problems import ProblemError


class UploadPlaces:
    """``limit`` places for each client; 0 is no limit."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._taken: Counter[str] = Counter()

    @contextmanager
    def taken(self, client: str | None) -> Iterator[None]:
        """A place for as long as the context; none is needed where there is no client to count.

        Raises:
            ProblemError: ``too_many_uploads``: all are taken.
        """
        if client is None or not self._limit:
            yield
            return
        if self._taken[client] >= self._limit:
            raise ProblemError(
                "too_many_uploads",
                f"{self._limit} uploads are under way, which is the limit.",
                hint="Go on when one of them is done.",
            )
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]

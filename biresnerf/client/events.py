"""A job's stream of server-sent events: read byte for byte, and taken up again where it broke off."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from biresnerf.client.calls import Call, Patience, Session
from biresnerf.client.errors import JobNotOver, ServiceError
from biresnerf.wire.jobs import FINAL_JOB_STATES, JobEvent, JobView, job_url

# The server's keep-alive comes every 15 s; three missed ones mean that the connection is dead.
_KEEP_ALIVE_S = 15.0
SILENCE_S = 50.0
_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0


@dataclass(frozen=True)
class Happening:
    """One message of the stream. ``data`` is a job for the kind ``progress``, else one of its events."""

    kind: str
    data: dict[str, Any]

    @property
    def job(self) -> JobView | None:
        """The job as it is now; none of an event."""
        return JobView.model_validate(self.data, extra="ignore") if self.kind == "progress" else None

    @property
    def event(self) -> JobEvent | None:
        """The event; none of progress."""
        return None if self.kind == "progress" else JobEvent.model_validate(self.data, extra="ignore")


class Following:
    """Follows one job over as many connections as it takes, and for so many seconds; each event comes once."""

    def __init__(self, session: Session, job_id: str, after: int, timeout_s: float | None = None) -> None:
        self._job_id, self._path, self._last = job_id, f"{job_url(job_id)}/events", after
        self._timeout_s = timeout_s
        self._ends = None if timeout_s is None else time.monotonic() + timeout_s
        self._in_last_stretch = False
        self._patience, self._pause_s = Patience(session), _PAUSE_S
        self._rest, self._fields = b"", dict[str, str]()
        self._final = False
        self.over = False

    def connect(self) -> Call:
        """The request that goes on from the last event. Raises `JobNotOver`."""
        self._rest, self._fields = b"", {}
        headers = {"Accept": "text/event-stream", "Last-Event-ID": str(self._last)}
        left_s = self._left_s()
        self._in_last_stretch = left_s < _KEEP_ALIVE_S
        return Call("GET", self._path, headers=headers, answer_s=min(SILENCE_S, max(0.01, left_s)))

    @property
    def connect_again(self) -> bool:
        """Whether this connection may be silent for longer than there is time left."""
        return not self.over and not self._in_last_stretch and self._left_s() < _KEEP_ALIVE_S

    def _left_s(self) -> float:
        """Seconds that are left; raises `JobNotOver` where there are none, unless the job is over."""
        if self._ends is None or self._timeout_s is None:
            return math.inf
        left_s = self._ends - time.monotonic()
        if left_s <= 0 and not self.over:
            raise JobNotOver(self._job_id, self._timeout_s)
        return left_s

    def take(self, chunk: bytes) -> Iterator[Happening]:
        """What the bytes complete."""
        self._patience.renew()
        # Only "\n" ends a line here: text in the messages may hold any other mark.
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        for line in lines:
            name, _, value = line.decode().rstrip("\r").partition(":")
            if name or value:
                self._note(name, value.removeprefix(" "))
            elif (happening := self._complete()) is not None:
                yield happening

    def _note(self, name: str, value: str) -> None:
        self._fields[name] = value
        if name == "retry" and value.isdecimal():
            self._pause_s = min(float(value) / 1000, _LONGEST_PAUSE_S)

    def _complete(self) -> Happening | None:
        fields, self._fields = self._fields, {}
        if "data" not in fields or "event" not in fields:
            return None
        self._last = int(fields.get("id", self._last))
        happening = Happening(fields["event"], json.loads(fields["data"]))
        # The event that ends the job comes last, after the job as it ended.
        self.over = self.over or happening.kind in FINAL_JOB_STATES
        self._final = happening.data.get("state") in FINAL_JOB_STATES
        return happening

    def ended(self) -> float:
        """The service ended the stream: seconds until the next connection."""
        self.over = self.over or self._final
        return 0.0 if self.over else min(self._pause_s, self._left_s())

    def broken(self, error: ServiceError) -> float:
        """The connection broke: seconds until the next one; raises the error where there should be none."""
        if self.over:
            return 0.0
        left_s = self._left_s()
        return min(max(self._pause_s, self._patience.after(error)), left_s)

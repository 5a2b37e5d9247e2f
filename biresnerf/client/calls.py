"""What a client does, as data: flows yield it, and a transport (blocking or asynchronous) does it.

A flow is a generator: what it yields is done for it, what came of that is sent back or raised in it, and what it
returns is the answer. So every operation is written once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any, Literal, Protocol, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError

from biresnerf.client.errors import ServiceError

ANSWER_S = 120.0
_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 8.0
Model = TypeVar("Model", bound=BaseModel)
T = TypeVar("T")


@dataclass(frozen=True)
class FilePart:
    """Bytes of a file from ``start`` to its end, as the body of a request. ``stop`` ends it early."""

    path: Path
    start: int
    size: int
    stop: Event
    on_bytes: Callable[[int], None] = lambda _: None


@dataclass(frozen=True)
class Call:
    """One HTTP request. ``again``: whether it may be sent twice, or only where the service did nothing with it."""

    method: str
    path: str
    params: Mapping[str, str | int] = field(default_factory=dict)
    json: Any = None
    content: FilePart | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    again: Literal["always", "undone"] = "always"
    answer_s: float = ANSWER_S


@dataclass(frozen=True)
class Answer:
    """What came back, below 400. Names of headers are in lower case."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    def model(self, kind: type[Model]) -> Model:
        """The body; raises `ServiceError`. A newer service may say more than this client knows."""
        try:
            return kind.model_validate_json(self.content, extra="ignore")
        except ValidationError:
            raise ServiceError.of_stranger(self.status) from None


class Sink(Protocol):
    """Takes an answer's bytes as they come."""

    def begin(self, status: int) -> None:
        """The answer's status, 200 or 206."""

    def take(self, chunk: bytes) -> None:
        """The next bytes."""


@dataclass(frozen=True)
class Stream:
    """A request whose answer goes into a sink, from wherever it redirects to."""

    call: Call
    sink: Sink


@dataclass(frozen=True)
class Pause:
    """Some seconds of doing nothing."""

    seconds: float


@dataclass(frozen=True)
class Work:
    """Something of this machine that takes a while (files to read); gives what it returns."""

    do: Callable[[], Any]


@dataclass(frozen=True)
class Together:
    """Flows side by side; the first that fails ends the others and is raised."""

    flows: Sequence[Flow[Any]]
    stop: Event
    lanes: int = 4


Effect: TypeAlias = Call | Stream | Pause | Work | Together
Flow: TypeAlias = Generator[Effect, Any, T]


@dataclass
class Session:
    """What all flows of one client share.

    Attributes:
        patience_s: how long what can succeed later is tried again.
        on_pause: hears why and how long is waited before another try.
        met: the service has answered before, so that it is worth waiting for.
    """

    url: str
    patience_s: float
    on_pause: Callable[[ServiceError, float], None] | None = None
    met: bool = False


class Patience:
    """How long to go on with something that fails: pauses that grow, or as the service asks."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._since: float | None = None
        self._pause_s = _PAUSE_S

    def renew(self) -> None:
        """There was progress."""
        self._since, self._pause_s = None, _PAUSE_S

    def after(self, error: ServiceError, *, again: Literal["always", "undone"] = "always") -> float:
        """Seconds to wait before the next try; raises the error where there should be none."""
        now = time.monotonic()
        self._since = self._since or now
        pause_s = self._pause_s if error.retry_after_s is None else error.retry_after_s
        worth_it = error.retryable and (again == "always" or error.undone)
        if error.code == "unreachable" and not self._session.met:
            worth_it = False  # most likely the address is wrong
        if not worth_it or now - self._since + pause_s > self._session.patience_s:
            raise error
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        if self._session.on_pause is not None:
            self._session.on_pause(error, pause_s)
        return pause_s


def ask(session: Session, call: Call) -> Flow[Answer]:
    """The answer, in the end; tries again as `Patience` allows."""
    patience = Patience(session)
    while True:
        try:
            answer: Answer = yield call
        except ServiceError as error:
            yield Pause(patience.after(error, again=call.again))
        else:
            return answer

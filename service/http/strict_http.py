"""HTTP/1.1 connections with time limits, and with problems as the response to malformed requests."""

from __future__ import annotations

import asyncio
import logging
import sys
import uuid
from typing import Any

import h11
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.http.problems import MEDIA_TYPE, ProblemError
from service.http.request_context import HEAD_BYTES_MAX

logger = logging.getLogger(__name__)

# Time allowed to receive a request's headers.
HEADERS_TIMEOUT_S = 20.0
# A client that reads nothing for so long is disconnected: it holds memory and a file open.
READER_TIMEOUT_S = 120.0
HEADERS_MAX = 100
_TOO_LARGE = 431


class _StrictHeads(h11.Connection):
    """Refuses request heads that `_Head` refuses. Each line is read once, however it arrives."""

    _head: _Head | None = None

    def next_event(self) -> Any:
        """As the base class's. Raises `h11.RemoteProtocolError`."""
        if self.their_state is h11.IDLE:
            self._head = self._head or _Head()
            self._head.read(self.trailing_data[0])
        event = super().next_event()
        if self.their_state is not h11.IDLE:
            self._head = None  # the next bytes are of another request
        return event


class _Head:
    """The lines of a request's head, as they arrive.

    Refuses what RFC 9112 allows but proxies may parse differently: lines that end without a carriage return (section
    2.2), headers continued on the next line (5.2), and a repeated length, even if equal (6.3). Refuses too many headers
    as well.
    """

    def __init__(self) -> None:
        self.lines = 0
        self._lengths = self._line_at = self._searched = 0

    def read(self, received: bytes) -> None:
        """Continue in ``received``, all bytes so far. Raises `h11.RemoteProtocolError`."""
        while (end := received.find(b"\n", self._searched)) >= 0:
            line = received[self._line_at : end]
            self._line_at = self._searched = end + 1
            self.lines += 1
            if not line.endswith(b"\r"):
                raise h11.RemoteProtocolError("a line of the head does not end with CR LF")
            if line == b"\r":
                return
            if line[:1] in (b" ", b"\t"):
                raise h11.RemoteProtocolError("a header goes on in the next line")
            if self.lines > 1 + HEADERS_MAX:
                raise h11.RemoteProtocolError(f"there are more than {HEADERS_MAX} headers", _TOO_LARGE)
            if line.lower().startswith(b"content-length:"):
                self._lengths += 1 + line.count(b",")
            if self._lengths > 1:
                raise h11.RemoteProtocolError("Content-Length is given twice")
        self._searched = len(received)


class StrictHttp(H11Protocol):
    """One connection. The base class responds to malformed requests in plain text and has no time limits."""

    _headers_timer: asyncio.TimerHandle | None = None
    _reader_timer: asyncio.TimerHandle | None = None

    def __init__(self, config: Config, *given: Any, **named: Any) -> None:
        super().__init__(config, *given, **named)
        self.conn = _StrictHeads(h11.SERVER, config.h11_max_incomplete_event_size or HEAD_BYTES_MAX)

    def connection_made(self, transport: Any) -> None:
        """Starts the time limit for the first request's headers."""
        super().connection_made(transport)
        self._time_headers()

    def data_received(self, data: bytes) -> None:
        """Stops the time limit once the headers are complete."""
        super().data_received(data)
        self._time_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancels all time limits."""
        super().connection_lost(exc)
        _stop(self._headers_timer)
        self._headers_timer = None
        _stop(self._reader_timer)
        self._reader_timer = None

    def pause_writing(self) -> None:
        """Starts the time limit of a client that does not read."""
        super().pause_writing()
        self._reader_timer = self._reader_timer or self.loop.call_later(
            READER_TIMEOUT_S, self.transport.abort
        )

    def resume_writing(self) -> None:
        """Stops the time limit: the client reads again."""
        super().resume_writing()
        _stop(self._reader_timer)
        self._reader_timer = None

    def send_400_response(self, msg: str) -> None:
        """Called by the base class while it handles the parser's error."""
        error = sys.exception()
        if isinstance(error, h11.RemoteProtocolError) and error.error_status_hint == _TOO_LARGE:
            detail = (
                f"The head of the request is larger than {HEAD_BYTES_MAX} bytes or {HEADERS_MAX} headers."
            )
            self._refuse(ProblemError("headers_too_large", detail))
        else:
            self._refuse(ProblemError("malformed_request", f"{error or msg}."))

    def _time_headers(self) -> None:
        awaits_headers = self.cycle is None or self.cycle.response_complete
        if not awaits_headers or self.transport.is_closing():
            _stop(self._headers_timer)
            self._headers_timer = None
        elif self._headers_timer is None:
            self._headers_timer = self.loop.call_later(HEADERS_TIMEOUT_S, self._headers_are_late)

    def _headers_are_late(self) -> None:
        self._headers_timer = None
        if not self.transport.is_closing():
            self._refuse(
                ProblemError("head_timeout", f"No whole request came within {HEADERS_TIMEOUT_S:g} s.")
            )

    def _refuse(self, error: ProblemError) -> None:
        """Responds unless a response has begun, and closes: where the next request begins is unknown."""
        request_id = uuid.uuid4().hex
        logger.info("refused: %s", error, extra={"fields": {"request_id": request_id, "client": self.client}})
        if self.conn.our_state in {h11.IDLE, h11.SEND_RESPONSE}:
            body = error.problem(request_id=request_id).model_dump_json(exclude_none=True).encode()
            headers = {
                "content-type": MEDIA_TYPE,
                "content-length": str(len(body)),
                "connection": "close",
                "x-content-type-options": "nosniff",
                "x-request-id": request_id,
            }
            answer = h11.Response(status_code=error.status, headers=list(headers.items()))
            for event in (answer, h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


def _stop(clock: asyncio.TimerHandle | None) -> None:
    if clock is not None:
        clock.cancel()

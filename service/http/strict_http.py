"""HTTP/1.1 as this service takes it from the wire: faults answered as problems, and nobody waited for without end."""

from __future__ import annotations

import asyncio
import logging
import sys
import uuid
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.http.problems import MEDIA_TYPE, ProblemError
from service.http.request_context import HEAD_BYTES_MAX

logger = logging.getLogger(__name__)

# Whoever opens a connection, or begins a request, has so long for its head.
HEAD_S = 20.0
# A client that takes nothing of its answer for so long holds memory and a file for nothing.
READER_STALLS_S = 120.0
_TOO_LARGE = 431


class StrictHttp(H11Protocol):
    """One connection. The framework behind it would answer faults in plain text and has no limits of time."""

    _head_due: asyncio.TimerHandle | None = None
    _reader_due: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """The time for the first head begins."""
        super().connection_made(transport)
        self._watch_head()

    def data_received(self, data: bytes) -> None:
        """Part of a head, or of a body; the time for a head ends with the head."""
        super().data_received(data)
        self._watch_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """No clock outlives the connection."""
        super().connection_lost(exc)
        _stop(self._head_due)
        self._head_due = None
        _stop(self._reader_due)
        self._reader_due = None

    def pause_writing(self) -> None:
        """The client does not take what was sent."""
        super().pause_writing()
        self._reader_due = self._reader_due or self.loop.call_later(READER_STALLS_S, self.transport.abort)

    def resume_writing(self) -> None:
        """It does again."""
        super().resume_writing()
        _stop(self._reader_due)
        self._reader_due = None

    def send_400_response(self, msg: str) -> None:
        """Called by the base class while it handles the fault that the parser found."""
        fault = sys.exception()
        if isinstance(fault, h11.RemoteProtocolError) and fault.error_status_hint == _TOO_LARGE:
            detail = f"The head of the request is larger than {HEAD_BYTES_MAX} bytes."
            self._refuse(ProblemError("headers_too_large", detail))
        else:
            self._refuse(ProblemError("malformed_request", f"{fault or msg}."))

    def _watch_head(self) -> None:
        head_is_due = self.cycle is None or self.cycle.response_complete
        if not head_is_due or self.transport.is_closing():
            _stop(self._head_due)
            self._head_due = None
        elif self._head_due is None:
            self._head_due = self.loop.call_later(HEAD_S, self._head_is_late)

    def _head_is_late(self) -> None:
        self._head_due = None
        if not self.transport.is_closing():
            self._refuse(ProblemError("head_timeout", f"No whole request came within {HEAD_S:g} s."))

    def _refuse(self, error: ProblemError) -> None:
        """Answers, where no answer has begun, and closes: what follows on this connection cannot be told apart."""
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

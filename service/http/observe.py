"""Counts, times and logs every request."""

from __future__ import annotations

import logging
import time

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.metrics import WebMetrics

logger = logging.getLogger("service.http.access")
_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
# Monitoring asks for these every few seconds: they are logged at debug level.
_PROBES = {"/livez", "/readyz", "/startupz", "/metrics"}
# nginx's status for a client that disconnected before the response began.
_CLIENT_GONE = 499


class Observed:
    """ASGI middleware around everything else."""

    def __init__(self, app: ASGIApp, metrics: WebMetrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        exchange = _Exchange(scope, receive, send)
        self._metrics.under_way.inc()
        try:
            await self._app(scope, exchange.receive, exchange.send)
        finally:
            self._metrics.under_way.dec()
            self._record(exchange)

    def _record(self, exchange: _Exchange) -> None:
        method, route, metrics = exchange.method, exchange.route, self._metrics
        metrics.requests.labels(method, route, str(exchange.status)).inc()
        metrics.received.labels(method, route).inc(exchange.received)
        metrics.sent.labels(method, route).inc(exchange.sent)
        if exchange.answered_s is not None:
            metrics.answer_s.labels(method, route).observe(exchange.answered_s)
        path = exchange.scope["path"]
        level = logging.DEBUG if is_probe(exchange.scope) and exchange.status < 400 else logging.INFO
        if logger.isEnabledFor(level):
            # The path without its query, which may hold a signature.
            logger.log(level, "%s %s %d", method, path, exchange.status, extra={"fields": exchange.fields()})


def is_probe(scope: Scope) -> bool:
    """Whether the request is a health check or a scrape."""
    return scope.get("path") in _PROBES


class _Exchange:
    """One request and its response."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.scope, self._receive, self._send = scope, receive, send
        self._began = time.perf_counter()
        self.status, self.received, self.sent = _CLIENT_GONE, 0, 0
        self.answered_s: float | None = None

    @property
    def method(self) -> str:
        """The method, or `other`: clients must not be able to create any number of time series."""
        return self.scope["method"] if self.scope["method"] in _METHODS else "other"

    @property
    def route(self) -> str:
        """The path with the names of its parameters in place of their values."""
        route = self.scope.get("route")
        return getattr(route, "path_format", None) or getattr(route, "path", None) or "unmatched"

    async def receive(self) -> Message:
        """The next message of the request."""
        message = await self._receive()
        self.received += len(message.get("body", b""))
        return message

    async def send(self, message: Message) -> None:
        """The next message of the response."""
        if message["type"] == "http.response.start":
            self.status, self.answered_s = message["status"], time.perf_counter() - self._began
        self.sent += len(message.get("body", b""))
        await self._send(message)

    def fields(self) -> dict[str, object]:
        """The fields of the log line."""
        state, client = self.scope.get("state", {}), self.scope.get("client")
        identity = state.get("identity")
        fields: dict[str, object] = {
            "request_id": state.get("request_id"),
            "tenant": getattr(identity, "tenant", None),
            "key": getattr(identity, "key_id", None),
            "client": client[0] if client else None,
            "route": self.route,
            "received": self.received,
            "sent": self.sent,
            "ms": round(1000 * (time.perf_counter() - self._began), 1),
        }
        return {name: value for name, value in fields.items() if value is not None}

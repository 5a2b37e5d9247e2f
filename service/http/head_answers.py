"""HEAD at every address that has GET: the same headers without a body."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class _AnsweredError(Exception):
    """The headers are out: what makes the body, perhaps without end, stops here."""


class HeadAnswers:
    """ASGI middleware around all routes; those that serve HEAD themselves do so."""

    def __init__(self, app: ASGIApp, methods_at: Callable[[str], Sequence[str]]) -> None:
        self._app, self._methods_at = app, methods_at

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        methods = self._methods_at(scope["path"]) if scope["type"] == "http" else ()
        if scope.get("method") != "HEAD" or "GET" not in methods or "HEAD" in methods:
            await self._app(scope, receive, send)
            return
        answered = False

        async def send_head(message: Message) -> None:
            nonlocal answered
            await send(message)
            if message["type"] == "http.response.start":
                await send({"type": "http.response.body", "body": b""})
                answered = True
                raise _AnsweredError

        scope["method"] = "GET"
        try:
            await self._app(scope, receive, send_head)
        except Exception:  # ours, perhaps in a group
            if not answered:
                raise
        finally:
            scope["method"] = "HEAD"

"""Request ids, security headers, and a response to every error that no handler caught."""

from __future__ import annotations

import asyncio
import logging
import re
import uuid
from urllib.parse import quote, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.hosts import is_host
from service.http.problems import MEDIA_TYPE, ProblemError
from workers.process.disk_space import refused_to_write
from workers.settings.logs import log_context

logger = logging.getLogger(__name__)
# A browser sends at most 8 KiB of cookies; a few long headers beside them fit in too.
HEAD_BYTES_MAX = 32 * 2**10
_SAFE = {"GET", "HEAD", "OPTIONS"}
# Responses are not pages, except the docs, which set their own policy; other sites may embed none.
_SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
_ID = re.compile(r"^[\w.:-]{1,128}$", re.ASCII)


def request_id(request: Request) -> str:
    """The id of this request."""
    found: str = request.scope.get("state", {}).get("request_id", "")
    return found


def render(error: ProblemError, request: Request) -> Response:
    """The response that carries the problem."""
    body = error.problem(instance=quote(request.scope["path"]), request_id=request_id(request))
    return Response(
        body.model_dump_json(exclude_none=True),
        status_code=error.status,
        media_type=MEDIA_TYPE,
        headers=error.response_headers(),
    )


class RequestContext:
    """ASGI middleware: request ids, security headers, and a problem for each uncaught error."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope, receive)
        given = request.headers.get("x-request-id", "")
        request.state.request_id = given if _ID.match(given) else uuid.uuid4().hex
        started = False

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id(request)
                for name, value in _SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                for name, value in scope.get("state", {}).get("extra_headers", {}).items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            _refuse_ambiguous(request)
            _refuse_other_pages(request)
            with log_context(request_id=request_id(request)):
                await self._app(scope, receive, send_with_headers)
            return
        except ProblemError as error:
            problem = error
        except asyncio.CancelledError:
            if started or not _stopping(request):
                raise
            # A request cut off by the shutdown was not served; another process can serve it.
            problem = ProblemError("unavailable", "The service is stopping.")
        except Exception as error:
            if started:
                raise
            problem = _unexpected(error, request)
        await render(problem, request)(scope, receive, send_with_headers)


def _refuse_ambiguous(request: Request) -> None:
    """Refuse requests that the parser accepts but a proxy in front of us may have parsed differently."""
    close = {"Connection": "close"}
    if request.scope["http_version"] not in {"1.0", "1.1"}:
        raise ProblemError("malformed_request", "This is not HTTP/1.", headers=close)
    if "content-length" in request.headers and "transfer-encoding" in request.headers:
        detail = "Content-Length and Transfer-Encoding exclude each other."
        raise ProblemError("malformed_request", detail, headers=close)
    # The framework would replace a Host that it cannot parse by the server's own address.
    host = request.headers.get("host")
    if host is not None and not is_host(host):
        raise ProblemError(
            "malformed_request", "The Host header is no host name.", where="Host", headers=close
        )
    if len(request.headers.getlist("authorization")) > 1:
        detail = "Authorization is given twice."
        raise ProblemError("malformed_request", detail, where="Authorization", headers=close)
    packed = request.headers.get("content-encoding", "identity")
    if packed.strip().lower() != "identity":
        detail = f"The body is sent packed ({packed[:40]!r}), which is not read."
        raise ProblemError("unsupported_media", detail, where="Content-Encoding", headers=close)
    # The parser limits only headers that arrive in pieces; those that arrive at once are measured here.
    head = [request.scope["raw_path"], request.scope["query_string"], *sum(request.scope["headers"], ())]
    if sum(map(len, head)) > HEAD_BYTES_MAX:
        detail = f"The head of the request is larger than {HEAD_BYTES_MAX} bytes."
        raise ProblemError("headers_too_large", detail, headers=close)


def _refuse_other_pages(request: Request) -> None:
    """Refuse requests from pages of other origins: browsers would send their forms to a local service.

    Browsers without Sec-Fetch-Site, or that leave it out over plain HTTP, send Origin. Another port of the same machine
    is another origin.
    """
    if request.method in _SAFE:
        return
    site, origin = request.headers.get("sec-fetch-site"), request.headers.get("origin")
    ours = site in {"same-origin", "none"}
    if site is None:
        ours = origin is None or _is_own(origin, request)
    if not ours:
        raise ProblemError("cross_site", "Requests from pages of other origins are refused.", where="Origin")


def _is_own(origin: str, request: Request) -> bool:
    """Whether the origin is this host, by HTTPS or the request's scheme: a proxy may have ended TLS."""
    try:
        page = urlsplit(origin)
    except ValueError:
        return False
    return page.scheme in {"https", request.scope["scheme"]} and page.netloc == request.headers.get("host")


def _stopping(request: Request) -> bool:
    service = getattr(request.app.state, "service", None)
    return service is not None and service.closing.is_set()


def _unexpected(error: Exception, request: Request) -> ProblemError:
    if isinstance(error, ClientDisconnect):
        return ProblemError("client_gone", "The client went away before its request was whole.")
    if refused_to_write(error):
        logger.error("the disk takes no more: %s", error)
        return ProblemError("storage_full", "The disk of the service is full or read-only.")
    logger.exception(
        "request %s %s %s failed", request_id(request), request.method, quote(request.scope["path"])
    )
    return ProblemError("internal_error", "The request failed; the service's log says why.")

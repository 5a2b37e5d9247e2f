"""What both transports have in common of HTTP: the key, time limits, and errors as `ServiceError`."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import httpx

from biresnerf.client.calls import Answer, Call
from biresnerf.client.errors import ServiceError

CHUNK_BYTES = 2**18
_CONNECT_S, _WRITE_S = 30.0, 120.0
# The service has surely not got the request.
_NOT_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
_REDIRECTIONS = frozenset({301, 302, 303, 307, 308})


class Bearer(httpx.Auth):
    """Shows the key to its own service alone, wherever a link or a redirection leads."""

    def __init__(self, home: httpx.URL, api_key: str) -> None:
        self._home, self._header = home, f"Bearer {api_key}"

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response]:
        url, home = request.url, self._home
        if (url.scheme, url.host, url.port) == (home.scheme, home.host, home.port):
            request.headers["Authorization"] = self._header
        yield request


def settings(url: str, api_key: str | None) -> dict[str, Any]:
    """Arguments of either of httpx's clients; raises `ServiceError` ``bad_url``."""
    try:
        home = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise bad_url(url, str(error)) from None
    if home.scheme not in {"http", "https"} or not home.host:
        raise bad_url(url, "it must begin with http:// or https://")
    return {
        "base_url": home,
        "auth": Bearer(home, api_key) if api_key else None,
        "headers": {"Accept": "application/json", "User-Agent": "biresnerf-client"},
    }


def bad_url(url: str, why: str) -> ServiceError:
    """The address cannot be one of a service."""
    return ServiceError("bad_url", f"{url!r} is no address of a service: {why}.", status=400)


def request_of(call: Call, content: Any) -> dict[str, Any]:
    """A call as arguments of httpx's ``request`` and ``stream``."""
    headers = dict(call.headers)
    if call.content is not None:
        headers["Content-Length"] = str(call.content.size - call.content.start)
    return {
        "method": call.method,
        "url": call.path,
        "params": dict(call.params) or None,
        "headers": headers,
        "timeout": httpx.Timeout(_CONNECT_S, read=call.answer_s, write=_WRITE_S),
        **({"json": call.json} if call.json is not None else {}),
        **({"content": content} if call.content is not None else {}),
    }


def answer_of(response: httpx.Response) -> Answer:
    """A read response; raises `ServiceError` where it is a refusal or a redirection that nobody expects."""
    if response.status_code >= 300:
        raise ServiceError.of_answer(response.status_code, response.headers, response.content)
    return Answer(response.status_code, response.headers, response.content)


def redirected(call: Call, response: httpx.Response) -> Call | None:
    """The request for the same bytes at the service's store; none where the answer is no redirection."""
    if response.status_code not in _REDIRECTIONS:
        return None
    # The store has tags of its own; files of a result never change.
    headers = {name: value for name, value in call.headers.items() if name != "If-Range"}
    return Call("GET", response.headers["location"], headers=headers, answer_s=call.answer_s)


def broken(url: str, call: Call, error: httpx.TransportError) -> ServiceError:
    """No answer came, or only a part of one."""
    if isinstance(error, httpx.LocalProtocolError) and call.content is not None:
        return ServiceError(
            "file_changed",
            "is not what it was when it was first read.",
            where=str(call.content.path),
            hint="Send again what does not change meanwhile.",
            status=422,
        )
    return ServiceError(
        "unreachable",
        f"No service answers at {url} ({str(error) or type(error).__name__}).",
        hint="Start one with `biresnerf up`, or give its address (--url, BIRESNERF_URL).",
        untouched=isinstance(error, _NOT_SENT),
    )


def stopped() -> ServiceError:
    """Another one of several requests failed, or the user wants no more."""
    return ServiceError("stopped", "Something else ended this request.")

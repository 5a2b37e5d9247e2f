"""HTTP requests to a service: the API key, time limits, retries, and failures as `ServiceError`."""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Iterable, Mapping
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, TypedDict, TypeVar

import anyio
import anyio.to_thread
import httpx
from pydantic import BaseModel, ValidationError

from biresnerf.client.errors import ServiceError
from biresnerf.client.retries import Again, Retries, RetryPolicy
from biresnerf.wire.base import Page

_CHUNK_BYTES = 2**18
_CONNECT_S, _WRITE_S, _ANSWER_S = 30.0, 120.0, 120.0
_PAGE_ITEMS = 200
_POLL_S, _LONGEST_POLL_S = 0.2, 5.0  # between two looks at what the service does
# The service certainly did not receive the request.
_NOT_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item")


@dataclass(frozen=True)
class FilePart:
    """The bytes of a file from ``start`` to ``size``, as the body of a request."""

    path: Path
    start: int
    size: int
    on_bytes: Callable[[int], object] = lambda _: None


@dataclass(frozen=True)
class Call:
    """One HTTP request. ``again`` says whether it may be sent twice; ``answer_s`` limits the wait for an answer."""

    method: str
    path: str
    params: Mapping[str, str | int] = field(default_factory=dict)
    json: Any = None
    content: FilePart | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    again: Again = "always"
    answer_s: float = _ANSWER_S


class _Bearer(httpx.Auth):
    """Sends the API key to the service alone, wherever a link or a redirection leads."""

    def __init__(self, service: httpx.URL, api_key: str) -> None:
        self._service, self._header = service, f"Bearer {api_key}"

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response]:
        url, service = request.url, self._service
        if (url.scheme, url.host, url.port) == (service.scheme, service.host, service.port):
            request.headers["Authorization"] = self._header
        yield request


class ClientOptions(TypedDict, total=False):
    """What a client takes besides the address of its service, see `Transport`."""

    api_key: str | None
    patience_s: float
    on_pause: Callable[[ServiceError, float], object] | None


class Transport:
    """Sends requests to one service; the base of all that a client can do."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        patience_s: float = 60.0,
        on_pause: Callable[[ServiceError, float], object] | None = None,
    ) -> None:
        """Makes no request yet.

        Args:
            url: the service's address.
            api_key: sent with every request, to the service alone.
            patience_s: how long a request that fails for a moment is retried.
            on_pause: called before each retry with the error and the seconds until then.

        Raises:
            ServiceError: ``bad_url``.
        """
        self.url = url.rstrip("/")
        address = _checked_url(self.url)
        self._policy = RetryPolicy(patience_s, on_pause)
        self._http = httpx.AsyncClient(
            base_url=address,
            auth=_Bearer(address, api_key) if api_key else None,
            headers={"Accept": "application/json", "User-Agent": "biresnerf-client"},
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes all connections."""
        await self._http.aclose()

    async def _ask(self, call: Call) -> httpx.Response:
        """The answer, after as many retries as the policy allows."""
        retries = Retries(self._policy)
        while True:
            try:
                return await self._send(call)
            except ServiceError as error:
                pause_s = retries.pause_after(error, again=call.again)
            await anyio.sleep(pause_s)

    async def _send(self, call: Call) -> httpx.Response:
        """The answer to a single try; raises `ServiceError` for an error or an unexpected redirection."""
        async with self._open(call) as response:
            await response.aread()
        if response.status_code >= 300:
            raise _refusal(response)
        return response

    @asynccontextmanager
    async def _open(self, call: Call) -> AsyncIterator[httpx.Response]:
        """The answer with its body unread; raises `ServiceError`, also while the body is read."""
        headers = dict(call.headers)
        timeout = httpx.Timeout(_CONNECT_S, read=call.answer_s, write=_WRITE_S)
        with ExitStack() as stack:
            body: dict[str, Any] = {} if call.json is None else {"json": call.json}
            if call.content is not None:
                headers["Content-Length"] = str(call.content.size - call.content.start)
                body = {"content": _chunks(stack.enter_context(call.content.path.open("rb")), call.content)}
            try:
                async with self._http.stream(
                    call.method,
                    call.path,
                    params=dict(call.params) or None,
                    headers=headers,
                    timeout=timeout,
                    **body,
                ) as response:
                    self._policy.answered = True
                    if response.status_code >= 400:
                        await response.aread()
                        raise _refusal(response)
                    yield response
            except httpx.TransportError as error:
                raise _unreachable(self.url, call, error) from None

    async def _collect(self, call: Call, kind: type[Page[Item]], limit: int | None) -> list[Item]:
        """The first ``limit`` items of a paged listing, or all of them."""
        found: list[Item] = []
        params = dict(call.params)
        while True:
            params["limit"] = _PAGE_ITEMS if limit is None else min(_PAGE_ITEMS, limit - len(found))
            page = parse(await self._ask(replace(call, params=params)), kind)
            found += page.items
            if page.next_cursor is None or (limit is not None and len(found) >= limit):
                return found
            params["cursor"] = page.next_cursor


def parse(response: httpx.Response, kind: type[Model]) -> Model:
    """The answer's body, without fields that only a newer service knows; raises `ServiceError`."""
    try:
        return kind.model_validate_json(response.content, extra="ignore")
    except ValidationError:
        raise ServiceError.of_foreign_answer(response.status_code) from None


async def tell(callback: Callable[..., object], *facts: object) -> None:
    """Calls a user's callback, and awaits it if it is a coroutine function."""
    answer = callback(*facts)
    if inspect.isawaitable(answer):
        await answer


async def looks() -> AsyncIterator[None]:
    """Yields repeatedly, with growing pauses, for polling the service."""
    pause_s = _POLL_S
    while True:
        yield
        await anyio.sleep(pause_s)
        pause_s = min(1.5 * pause_s, _LONGEST_POLL_S)


async def run_together(works: Iterable[Callable[[], Awaitable[object]]], at_once: int = 4) -> None:
    """Runs ``works``, ``at_once`` at a time; the first failure cancels the others and is raised."""
    waiting = iter(works)

    async def lane() -> None:
        for work in waiting:
            await work()

    try:
        async with anyio.create_task_group() as tasks:
            for _ in range(at_once):
                tasks.start_soon(lane)
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


async def _chunks(source: BinaryIO, part: FilePart) -> AsyncIterator[bytes]:
    source.seek(part.start)
    while chunk := await anyio.to_thread.run_sync(source.read, _CHUNK_BYTES):
        yield chunk
        await tell(part.on_bytes, len(chunk))


def _checked_url(url: str) -> httpx.URL:
    try:
        address = httpx.URL(url)
        problem = (
            "" if address.scheme in {"http", "https"} and address.host else "it is not http:// or https://"
        )
    except httpx.InvalidURL as error:
        problem = str(error)
    if problem:
        raise ServiceError("bad_url", f"{url!r} is not the address of a service: {problem}.", status=400)
    return address


def _refusal(response: httpx.Response) -> ServiceError:
    return ServiceError.of_answer(response.status_code, response.headers, response.content)


def _unreachable(url: str, call: Call, error: httpx.TransportError) -> ServiceError:
    """The error for a missing or incomplete answer."""
    if isinstance(error, httpx.LocalProtocolError) and call.content is not None:
        return ServiceError(
            "file_changed",
            "has changed since it was first read.",
            where=str(call.content.path),
            hint="Submit again while nothing writes to it.",
            status=422,
        )
    return ServiceError(
        "unreachable",
        f"No service answers at {url} ({str(error) or type(error).__name__}).",
        hint="Start one with `biresnerf up`, or give its address (--url, BIRESNERF_URL).",
        untouched=isinstance(error, _NOT_SENT),
    )

"""All outgoing requests to users' addresses, with protection against SSRF: POST messages, GET and PUT files.

The host name is resolved once, all its addresses are checked, and the connection uses a checked address; TLS and
the Host header keep the name. Only GET follows redirects, each checked like the first address, and only GET reads the
response's body.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import httpcore
import httpx

from biresnerf.errors import InputError
from workers.settings.addresses import Network, may_connect, parsed
from workers.settings.settings import Settings

# A signed address of a file is long: it may hold a session's token.
URL_MAX, FILE_URL_MAX = 2000, 8000
REDIRECTS, REDIRECTS_MAX = {301, 302, 303, 307, 308}, 5
CONNECT_S = 10.0  # per address of a name; then the next is tried
# Names resolved at a time; others wait.
RESOLVER_THREADS = 32
_HOST = re.compile(rb"(?=.{1,253}$)([A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?\.)*[A-Za-z0-9-]{1,63}\.?")
_LOCAL_SUFFIXES = (".localhost", ".local", ".internal", ".home.arpa")
Resolve = Callable[[str, int], Awaitable[Sequence[str]]]


class Refused(Exception):
    """Nothing was sent; ``code`` says why.

    ``address_refused``, ``name_not_found``, ``url_refused``, and for GET ``too_many_redirects``.
    """

    def __init__(self, code: str) -> None:
        self.code = code
        super().__init__(code)


@dataclass(frozen=True)
class Policy:
    """Where the service may connect to; ``refusal`` is the error code for other addresses."""

    plain_http: bool = False
    ports: tuple[int, ...] = (443,)  # none: any
    networks: tuple[Network, ...] = ()
    url_max: int = URL_MAX
    refusal: str = "webhook_url_refused"

    @classmethod
    def of(cls, settings: Settings) -> Policy:
        """The policy for webhooks."""
        return cls(settings.webhook_http, settings.webhook_ports, settings.webhook_networks)

    @classmethod
    def of_files(cls, settings: Settings) -> Policy:
        """The policy for files, separate because users see their content, but little of the response to a webhook."""
        allowed = settings.file_address_http, settings.file_address_ports, settings.file_address_networks
        return cls(*allowed, FILE_URL_MAX, "address_refused")


def checked_url(text: str, policy: Policy) -> httpx.URL:
    """The parsed address, if `Outbound` may use it; its host is checked again at each resolution.

    Raises `InputError` with the policy's code. The error does not repeat the address, which may be a secret.
    """
    try:
        url = httpx.URL(text)
        port = url.port if url.port is not None else {"https": 443}.get(url.scheme, 80)
        too_long = f"It is longer than {policy.url_max:,} characters."
        reason = too_long if len(text) > policy.url_max else _fault(url, port, policy)
    except (httpx.InvalidURL, ValueError, TypeError):
        reason = "It is no URL."
    if reason:
        hint = "Give the https address of a public host." if not policy.plain_http else ""
        raise InputError(policy.refusal, f"This address cannot be used. {reason}", hint=hint)
    return url


def _fault(url: httpx.URL, port: int, policy: Policy) -> str:
    host = url.raw_host
    if url.scheme != "https" and not (policy.plain_http and url.scheme == "http"):
        return "The scheme must be https."
    if url.userinfo or url.fragment:
        return "It must hold neither a user nor a fragment."
    if not 0 < port < 65536 or (policy.ports and port not in policy.ports):
        return f"Its port must be one of {', '.join(map(str, policy.ports)) or '1 to 65535'}."
    literal = _literal(host)
    if literal is None and (not _HOST.fullmatch(host) or _looks_like_a_number(host)):
        return "Its host is no name and no address in the usual form."
    name = url.host.lower().rstrip(".")
    local = name == "localhost" or name.endswith(_LOCAL_SUFFIXES)
    if (literal is not None and not may_connect(literal, policy.networks)) or (local and not policy.networks):
        return "Its host is not a public one."
    return ""


def _literal(host: bytes) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.decode("ascii"))
    except ValueError:
        return None


def _looks_like_a_number(host: bytes) -> bool:
    """Old spellings of IPv4 addresses that resolvers accept: 0x7f.1, 2130706433, 0177.0.0.1."""
    last = host.rstrip(b".").rpartition(b".")[2]
    return last.isdigit() or bool(re.fullmatch(rb"0[xX][0-9a-fA-F]*", last))


class SystemResolver:
    """The system's resolver, in its own threads, so that slow failures block nothing else."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(RESOLVER_THREADS, "resolve")

    async def __call__(self, host: str, port: int) -> Sequence[str]:
        """Numeric addresses; raises `OSError`."""
        ask = partial(socket.getaddrinfo, host, port, type=socket.SOCK_STREAM)
        found = await asyncio.get_running_loop().run_in_executor(self._threads, ask)
        return list(dict.fromkeys(str(entry[4][0]) for entry in found))


class _CheckedBackend(httpcore.AsyncNetworkBackend):
    """Connects to checked addresses only. The caller passes the host name to TLS."""

    def __init__(self, policy: Policy, resolve: Resolve) -> None:
        self._policy, self._resolve = policy, resolve
        self._network = httpcore.AnyIOBackend()

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        try:
            addresses = [parsed(text) for text in await self._resolve(host, port)]
        except (OSError, UnicodeError) as error:
            raise Refused("name_not_found") from error
        # One forbidden address is enough to refuse the name: the answer may change at each resolution.
        if not addresses or not all(may_connect(item, self._policy.networks) for item in addresses):
            raise Refused("address_refused" if addresses else "name_not_found")
        for number, address in enumerate(addresses):
            try:
                return await self._network.connect_tcp(str(address), port, timeout)
            except (httpcore.ConnectError, httpcore.ConnectTimeout):
                if number + 1 == len(addresses):
                    raise
        raise AssertionError("unreachable: the last address returns or raises")


@dataclass(frozen=True)
class Answer:
    """A response: status, and headers by lower-case name."""

    status: int
    headers: Mapping[str, str]


# Errors of a request that are not our fault.
TROUBLES = (Refused, TimeoutError, httpcore.TimeoutException, httpcore.NetworkError, httpcore.ProtocolError)


def trouble_of(error: BaseException) -> tuple[str, bool]:
    """The code of one of the `TROUBLES`, and whether a retry may help."""
    if isinstance(error, Refused):
        return error.code, error.code == "name_not_found"
    if isinstance(error, httpcore.NetworkError):
        return ("tls_failed" if _of_tls(error) else "connection_failed"), True
    return ("not_http" if isinstance(error, httpcore.ProtocolError) else "timeout"), True


def _of_tls(error: BaseException) -> bool:
    while error.__cause__ is not None or error.__context__ is not None:
        cause = error.__cause__ or error.__context__
        assert cause is not None, "one of the two is there"
        if isinstance(cause, ssl.SSLError):
            return True
        error = cause
    return False


class Outbound:
    """Sends to addresses given by users."""

    def __init__(
        self,
        policy: Policy,
        *,
        resolve: Resolve | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._policy = policy
        self._backend = _CheckedBackend(policy, resolve or SystemResolver())
        # Honours SSL_CERT_FILE and SSL_CERT_DIR, for installations with a private certificate authority.
        self._tls = tls or httpx.create_ssl_context()

    async def send(
        self,
        method: Literal["POST", "PUT"],
        address: str,
        body: bytes | AsyncIterator[bytes],
        headers: Mapping[str, str],
        *,
        size: int,
        timeout_s: float,
    ) -> Answer:
        """Send a body of ``size`` bytes and return the first response, with any status, without its body.

        Raises `Refused`, `TimeoutError` (``timeout_s`` for the whole exchange), and httpcore's
        `NetworkError` and `ProtocolError`.
        """
        headers = {**headers, "Content-Length": str(size)}
        async with asyncio.timeout(timeout_s), self._sent(method, address, headers, body) as response:
            return _answer(response)

    @asynccontextmanager
    async def get(
        self, address: str, headers: Mapping[str, str], *, head_s: float, idle_s: float
    ) -> AsyncIterator[tuple[Answer, AsyncIterator[bytes]]]:
        """The response to a GET, with any status, after at most `REDIRECTS_MAX` redirects, and its body.

        Raises as `send` does: `TimeoutError` after ``head_s`` until the last answer begins, or after ``idle_s``
        between two chunks of its body.
        """
        async with AsyncExitStack() as opened:
            async with asyncio.timeout(head_s):
                for _ in range(REDIRECTS_MAX + 1):
                    await opened.aclose()
                    response = await opened.enter_async_context(self._sent("GET", address, headers))
                    answer = _answer(response)
                    if answer.status not in REDIRECTS or "location" not in answer.headers:
                        break
                    address = _joined(address, answer.headers["location"])
                else:
                    raise Refused("too_many_redirects")
            chunks = aiter(response.aiter_stream())  # as sent, without decompression
            yield answer, _steady(chunks, idle_s)

    @asynccontextmanager
    async def _sent(
        self,
        method: str,
        address: str,
        headers: Mapping[str, str],
        body: bytes | AsyncIterator[bytes] | None = None,
    ) -> AsyncIterator[httpcore.Response]:
        try:
            url = checked_url(address, self._policy)
        except InputError:
            raise Refused("url_refused") from None
        # Built from the checked parts: a second parser might read the same text differently.
        target = httpcore.URL(
            scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path or b"/"
        )
        wire = [(b"Host", url.netloc), *((key.encode(), value.encode()) for key, value in headers.items())]
        # A new connection for each request, so that each one uses a freshly checked address.
        pool = httpcore.AsyncConnectionPool(
            ssl_context=self._tls, network_backend=self._backend, max_connections=1
        )
        limits = {"timeout": {"connect": CONNECT_S}}
        async with (
            pool,
            pool.stream(method, target, headers=wire, content=body, extensions=limits) as response,
        ):
            yield response


def _answer(response: httpcore.Response) -> Answer:
    headers = {key.decode("latin-1").lower(): value.decode("latin-1") for key, value in response.headers}
    return Answer(response.status, headers)


def _joined(address: str, location: str) -> str:
    try:
        return str(httpx.URL(address).join(location))
    except (httpx.InvalidURL, ValueError, TypeError):
        raise Refused("url_refused") from None


async def _steady(chunks: AsyncIterator[bytes], idle_s: float) -> AsyncIterator[bytes]:
    while True:
        async with asyncio.timeout(idle_s):
            try:
                chunk = await anext(chunks)
            except StopAsyncIteration:
                return
        yield chunk

"""Authentication and scopes.

`Access` identifies every request, except those of `OPEN`, before its body is read, so a route that declares nothing
is closed. A route's parameter declares the scope it needs: `ReadCaller` (``read``), `DatasetWriter`,
`JobWriter`, `Admin`.
"""

from __future__ import annotations

import contextlib
import hmac
import logging
import math
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Security
from fastapi.security import HTTPBearer, SecurityScopes
from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from biresnerf.wire.results import LinkView
from service.http.dependencies import Service, service_of
from service.http.hosts import is_public_name, on_loopback
from service.http.link_access import LINK_PREFIX, require_shown
from service.http.problems import ProblemError, problem_of
from workers.datasets.datasets import DatasetStore
from workers.datasets.uploads import UploadStore
from workers.jobs.jobs import JobStore
from workers.jobs.result_links import ResultLinkStore
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.tenants.api_keys import ALL_SCOPES, KeyRefused
from workers.tenants.api_keys import Scope as KeyScope
from workers.tenants.tenants import LOCAL_TENANT
from workers.webhooks.webhooks import WebhookStore

log = logging.getLogger(__name__)

# Health checks, docs and schema contain no user's data; /metrics checks for itself (`may_scrape`); shared links are
# signed.
OPEN = re.compile(
    r"/(livez|readyz|startupz|metrics|openapi\.json|docs(/.*)?|web/[^/]*|example/.*|v1/shared/.*)?"
)
# Problems of every guarded operation; its route need not declare them.
REFUSALS = (
    *("missing_credentials", "invalid_api_key", "scope_required", "cross_site"),
    *("rate_limited", "database_unavailable"),
)
# Requests from one address without a valid key.
UNIDENTIFIED_PER_S, UNIDENTIFIED_BURST = 1.0, 200
_BEARER = re.compile(r"Bearer +(\S+) *", re.IGNORECASE)
_CHALLENGE = 'Bearer realm="biresnerf"'


@dataclass(frozen=True)
class RateLimit:
    """Per client, over all web processes: at most ``burst`` requests at once, ``rate`` a second on average."""

    policy: str
    rate: float
    burst: int

    async def take(self, request: Request, client: str) -> dict[str, str]:
        """Counts a request; returns the headers of draft-ietf-httpapi-ratelimit-headers.

        Raises:
            ProblemError: ``rate_limited``: the request exceeds the limit.
            Unavailable: the database does not answer.
        """
        level = await service_of(request).stores.buckets.take(self.policy, client, self.rate, self.burst)
        window_s = max(1, math.ceil(level.full_in_s))
        headers = {
            "RateLimit-Policy": f'"{self.policy}";q={self.burst}',
            "RateLimit": f'"{self.policy}";r={int(level.tokens)};t={window_s}',
        }
        if level.wait_s:
            raise ProblemError(
                "rate_limited",
                f"At most {self.burst} requests are taken at once.",
                headers={**headers, "Retry-After": str(math.ceil(level.wait_s))},
            )
        return headers


@dataclass(frozen=True)
class Identity:
    """The tenant and the scopes of a request. ``key_id`` is None where no key is needed.

    ``link`` is set for a request by link, which can read only one job.
    """

    tenant: str
    scopes: frozenset[KeyScope]
    key_id: str | None = None
    link: LinkView | None = None


@dataclass(frozen=True)
class Caller:
    """The identified client of a request, with the stores limited to its tenant.

    Limits are counted per ``client``: the key, or without one the address; None on loopback.
    """

    service: Service
    tenant: str
    scopes: frozenset[KeyScope]
    client: str | None
    link: LinkView | None
    jobs: JobStore
    datasets: DatasetStore
    uploads: UploadStore
    webhooks: WebhookStore
    links: ResultLinkStore

    def require(self, scope: KeyScope) -> None:
        """Raises ``ProblemError`` (``scope_required``) if the caller lacks the scope."""
        if scope not in self.scopes:
            challenge = f'{_CHALLENGE}, error="insufficient_scope", scope="{scope}"'
            raise ProblemError(
                "scope_required", f"The key lacks the scope {scope}.", headers={"WWW-Authenticate": challenge}
            )

    def sending(self) -> AbstractContextManager[object]:
        """Counts an upload while it runs; raises ``ProblemError`` (``too_many_uploads``) at the client's limit."""
        return self.service.sending.counted(self.client, 1)


class Access:
    """ASGI middleware: identifies the client of each request before its body is read or its route is looked up."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings
        self._keys = RateLimit("key", settings.key_requests_per_s, settings.key_requests_burst)
        self._unidentified = RateLimit("address", UNIDENTIFIED_PER_S, UNIDENTIFIED_BURST)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or OPEN.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        try:
            left = await self._left(request)
        except Unavailable as error:  # above the routes: no exception handler responds with 503
            raise problem_of(error) from None

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(left)
            await send(message)

        await self._app(scope, receive, send_with_headers)

    async def _left(self, request: Request) -> dict[str, str]:
        """Identifies the client and counts its request; returns rate-limit headers, none where it has no limit."""
        request.state.identity = identity = await self._identified(request)
        anonymous = None if on_loopback(self._settings.host) else _address(request)
        request.state.client = client = identity.key_id or anonymous
        return {} if client is None else await self._keys.take(request, client)

    async def _identified(self, request: Request) -> Identity:
        try:
            return await identify(service_of(request), request)
        except ProblemError as refusal:
            # A valid key is never limited by what others send from the same address.
            if refusal.status == 401:
                await self._unidentified.take(request, _address(request))
            raise


def _address(request: Request) -> str:
    return request.client.host if request.client else ""


async def identify(service: Service, request: Request) -> Identity:
    """The identity of the request.

    Raises:
        ProblemError: ``missing_credentials``, ``invalid_api_key``, ``cross_site``.
    """
    text = request.headers.get("authorization")
    if text is None:
        return await _anonymous(service, request)
    bearer = _BEARER.fullmatch(text)
    if bearer is None:
        raise _unknown("The Authorization header is not of the form `Bearer brn_…`.")
    if bearer[1].startswith(LINK_PREFIX):
        found = await service.stores.links.recognise(bearer[1])
        if found is None:
            raise _unknown("The link is unknown, expired or revoked.")
        link, tenant = found
        require_shown(link.job_id, request.method, request.scope["path"])
        return Identity(tenant, frozenset({"read"}), link.id, link)
    try:
        key = await service.stores.keys.recognise(bearer[1])
    except KeyRefused:
        raise _unknown("The key is unknown, expired or revoked.") from None
    scopes = ALL_SCOPES if "admin" in key.scopes else frozenset(key.scopes)
    return Identity(key.tenant, scopes, key.id)


async def _anonymous(service: Service, request: Request) -> Identity:
    """The identity of a request without a key, where none is required."""
    if await _needs_key(service):
        raise ProblemError(
            "missing_credentials",
            "This service requires an API key.",
            where="Authorization",
            hint="Send the header `Authorization: Bearer brn_…`; `biresnerf keys create` makes a key.",
            headers={"WWW-Authenticate": _CHALLENGE},
        )
    if service.settings.auth == "auto" and is_public_name(request.url.hostname or ""):
        # DNS rebinding: a page's own host name may resolve to this machine and then count as same-site.
        raise ProblemError(
            "cross_site",
            "Without an API key only requests to this machine by its own name are accepted.",
            where="Host",
            hint="Use http://127.0.0.1 or localhost, or make a key: biresnerf keys create.",
        )
    return Identity(LOCAL_TENANT, ALL_SCOPES)


async def _needs_key(service: Service) -> bool:
    if service.settings.auth == "auto":
        return not on_loopback(service.settings.host) or await service.stores.keys.any_made()
    return service.settings.auth == "required"


async def log_access(service: Service) -> None:
    """Logs at startup who can access the service."""
    settings = service.settings
    if settings.auth == "off" and not on_loopback(settings.host):
        log.warning("BIRESNERF_AUTH=off: anyone who can reach %s has full access", settings.host)
    elif settings.auth == "required" or (settings.auth == "auto" and not on_loopback(settings.host)):
        with contextlib.suppress(Unavailable):
            if not await service.stores.keys.any_made():
                log.warning(
                    "no API key exists yet, so no client has access; create one: biresnerf keys create NAME"
                )


async def may_scrape(service: Service, request: Request) -> bool:
    """Whether the client may read /metrics: with the token or an ``admin`` key, or where neither is needed.

    The database is asked only if nothing else allows it.
    """
    token = service.settings.metrics_token
    authorization = request.headers.get("authorization")
    if authorization is None:
        return (
            token is None
            and on_loopback(service.settings.host)
            and "admin" in await _scopes(service, request)
        )
    bearer = _BEARER.fullmatch(authorization)
    if bearer is None:
        return False
    if token is not None and hmac.compare_digest(token.get_secret_value().encode(), bearer[1].encode()):
        return True
    return "admin" in await _scopes(service, request)


async def _scopes(service: Service, request: Request) -> frozenset[KeyScope]:
    """The scopes of the request; none if it would be refused."""
    try:
        return (await identify(service, request)).scopes
    except ProblemError:
        return frozenset()


def _unknown(detail: str) -> ProblemError:
    return ProblemError(
        "invalid_api_key",
        detail,
        where="Authorization",
        headers={"WWW-Authenticate": f'{_CHALLENGE}, error="invalid_token"'},
    )


_bearer = HTTPBearer(
    auto_error=False,
    scheme_name="ApiKey",
    bearerFormat="brn_…",
    description="An API key. None is needed while the service listens on loopback only and no key was made.",
)


async def _caller(
    request: Request, needed: SecurityScopes, _documented: Annotated[Any, Security(_bearer)]
) -> Caller:
    service, identity = service_of(request), request.state.identity
    tenant, stores = identity.tenant, service.stores
    caller = Caller(
        *(service, tenant, identity.scopes, request.state.client, identity.link),
        jobs=stores.jobs.for_tenant(tenant, identity.key_id),
        datasets=stores.datasets.for_tenant(tenant),
        uploads=stores.uploads.for_tenant(tenant),
        webhooks=stores.webhooks.for_tenant(tenant),
        links=stores.links.for_tenant(tenant),
    )
    for scope in needed.scopes:
        caller.require(scope)  # type: ignore[arg-type]
    return caller


ReadCaller = Annotated[Caller, Security(_caller, scopes=["read"])]
DatasetWriter = Annotated[Caller, Security(_caller, scopes=["datasets:write"])]
JobWriter = Annotated[Caller, Security(_caller, scopes=["jobs:write"])]
Admin = Annotated[Caller, Security(_caller, scopes=["admin"])]

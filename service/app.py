"""The web application: its routes, the engine while it runs, and a problem response for every error."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from biresnerf import __version__
from biresnerf.errors import FaultError
from service import web_page
from service.docs import docs_page
from service.docs.api_description import describe
from service.http.access import Access, log_access
from service.http.dependencies import Service
from service.http.metrics import WebMetrics
from service.http.observe import Observed, is_probe
from service.http.problems import ProblemError, problem_of
from service.http.request_context import RequestContext, render
from service.intake.archive_import import import_upload
from service.intake.json_body import validation_problem
from service.routes import (
    artifacts,
    batches,
    datasets,
    derived_jobs,
    events,
    health,
    jobs,
    meta,
    photos,
    sample,
    shares,
    signed_uploads,
    uploads,
    webhooks,
)
from workers.engine import open_stores
from workers.process.locked_folders import sweep_folders
from workers.process.watchdog import end_if_hung
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.settings.traces import flush_traces

logger = logging.getLogger(__name__)

_UNFINISHED_EVERY_S = 15.0
_BROKEN_S = 30.0  # long enough for a probe of /livez to see it
_RESOURCES = (
    datasets,
    photos,
    uploads,
    signed_uploads,
    jobs,
    batches,
    derived_jobs,
    events,
    artifacts,
    shares,
    webhooks,
)
_ROUTERS = [module.router for module in (*_RESOURCES, meta, sample, health, docs_page, web_page)]
_DESCRIPTION = """
Refines the camera poses of an image set.

1. `POST /v1/datasets`, with a manifest to learn which files to send; then `PUT …/files/{path}` for each file,
   `POST …/archive` for all of them, `POST …/uploads` for resumable uploads, or `POST …/fetches` for addresses that the
   service fetches; then `POST …/finalize`.
2. `POST /v1/jobs` with the dataset's id (or one multipart request with an archive does both).
3. `GET /v1/jobs/{id}` or its event stream reports the progress.
4. `GET /v1/jobs/{id}/artifacts` lists the refined poses, the report and the renders.

Every error is `application/problem+json` (RFC 9457) with a stable `code`.
"""


def create_app(settings: Settings) -> FastAPI:
    """The application; opens the engine when it starts (needs ``settings.database_url`` of a migrated database)."""
    metrics = WebMetrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with end_if_hung(), open_stores(settings) as stores:
            service = Service(settings, stores, metrics)
            app.state.service = service
            swept = await asyncio.to_thread(sweep_folders, service.staging_dir)
            if swept:
                logger.info("removed %d unfinished uploads", swept)
            service.keep_running(_repeat(finish_checks, service, _UNFINISHED_EVERY_S))
            # Uploads that a dispatcher fetched, too; a client may be waiting for them.
            service.keep_running(_repeat(finish_uploads, service, settings.poll_s))
            # Workers do the same; without any, trash and tallies would pile up.
            service.keep_running(stores.janitor.run())
            service.keep_running(_stop_if_broken(service))
            await log_access(service)
            try:
                yield
            finally:
                service.closing.set()
                await asyncio.to_thread(flush_traces)
                for task in service.background:
                    task.cancel()
                await asyncio.gather(*service.background, return_exceptions=True)

    app = FastAPI(
        title="BiResNeRF",
        version=__version__,
        summary="Camera pose refinement as a service.",
        description=_DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        generate_unique_id_function=_operation_id,
        # Spans of requests, once `set_up_traces` was called.
        telemetry={"metrics": False, "logs": False, "operation_spans": False, "exclude": is_probe},
    )
    app.add_middleware(Access, settings=settings)
    app.add_middleware(HeadAnswers, methods_at=_methods_at)
    app.add_middleware(RequestContext)  # renders what Access refuses
    app.add_middleware(Observed, metrics=metrics)
    _answer_with_problems(app)
    for router in _ROUTERS:
        app.include_router(router)
    describe(app, _ROUTERS)
    return app


def _operation_id(route: APIRoute) -> str:
    """`getJob` for the function `get_job`; `headArtifact` where `get_artifact` also serves HEAD."""
    verb, *words = route.name.split("_")
    return ("head" if route.methods == {"HEAD"} else verb) + "".join(word.capitalize() for word in words)


async def _repeat(work: Callable[[Service], Awaitable[None]], service: Service, pause_s: float) -> None:
    """Repeats the work forever, also after it failed."""
    while True:
        try:
            await work(service)
        except Unavailable as error:
            logger.warning("unfinished checks and uploads are waiting: %s", error.detail)
        except Exception:
            logger.exception("%s failed; it will be retried", work.__name__)
        await asyncio.sleep(pause_s)


async def _stop_if_broken(service: Service) -> None:
    """Stops the process once its database connections are lost: only an ended process is restarted."""
    await service.stores.monitor.broken.wait()
    await asyncio.sleep(_BROKEN_S)
    signal.raise_signal(signal.SIGTERM)


async def finish_checks(service: Service) -> None:
    """Finishes checks whose process was killed."""
    for dataset_id in await service.stores.datasets.unfinished():
        try:
            await service.stores.datasets.check(dataset_id)
        except (FaultError, OSError) as error:  # deleted meanwhile, for example; go on with others
            logger.warning("dataset %s is not checked yet: %s", dataset_id, error)


async def finish_uploads(service: Service) -> None:
    """Finishes uploads that another process received or fetched but did not store; deletes those that expired."""
    for upload_id in await service.stores.uploads.not_imported():
        try:
            await import_upload(service, upload_id)
        except (FaultError, OSError) as error:  # go on with others
            logger.warning("upload %s is received but not stored yet: %s", upload_id, error)
    await service.stores.uploads.expire()


def _answer_with_problems(app: FastAPI) -> None:
    async def problem(request: Request, error: Exception) -> Response:
        answer = _as_problem(error)
        if answer.code == "method_not_allowed":
            # The framework names the methods of the first route at this path only.
            there = set(_methods_at(request.scope["path"]))
            answer.headers["Allow"] = ", ".join(sorted(there | ({"HEAD"} if "GET" in there else set())))
        return render(answer, request)

    for kind in (FaultError, RequestValidationError, HTTPException):
        app.add_exception_handler(kind, problem)


def _methods_at(path: str) -> list[str]:
    """All methods that routes have at the path."""
    found: set[str] = set()
    for router in _ROUTERS:
        for route in router.routes:
            if isinstance(route, Route) and route.path_regex.match(path):
                found |= route.methods or set()
    return sorted(found)


def _as_problem(error: Exception) -> ProblemError:
    if isinstance(error, FaultError):
        return problem_of(error)
    if isinstance(error, RequestValidationError):
        return validation_problem(error.errors())
    if isinstance(error, HTTPException):
        return _from_http_exception(error)
    raise error


def _from_http_exception(error: HTTPException) -> ProblemError:
    codes = {404: "not_found", 405: "method_not_allowed", 413: "body_too_large", 415: "unsupported_media"}
    code = codes.get(error.status_code, "malformed_body" if error.status_code < 500 else "internal_error")
    detail = {
        "not_found": "There is nothing at this address.",
        "method_not_allowed": "This address supports other methods; see the Allow header.",
    }.get(code, str(error.detail))
    return ProblemError(code, detail, headers=dict(error.headers or {}))


class _AnsweredError(Exception):
    """Raised once the headers are sent, to stop a body that may never end."""


class HeadAnswers:
    """ASGI middleware that answers HEAD by GET, except for routes that handle HEAD themselves."""

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
        except Exception:  # an _AnsweredError, possibly in a group
            if not answered:
                raise
        finally:
            scope["method"] = "HEAD"

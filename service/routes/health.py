"""Health checks and metrics for Prometheus. Health checks need no API key."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Request
from fastapi.responses import PlainTextResponse, Response

from biresnerf.wire.problems import FieldProblem
from biresnerf.wire.service import Health
from service.http.access import may_scrape
from service.http.dependencies import CurrentService, Service, service_of
from service.http.metrics import Exposition
from service.http.problems import ProblemError, declared
from workers.settings.errors import Unavailable
from workers.upkeep.monitor import Need

router = APIRouter(tags=["service"])
_NEEDS: tuple[Need, ...] = ("database", "storage", "queue")  # what the others depend on first
_LACKING = (*(f"{need}_unavailable" for need in _NEEDS), "unavailable")


@router.get("/livez", responses=declared("unavailable"))
async def livez(request: Request) -> Health:
    """The process runs and responds. Its dependencies are not checked: a restart would not repair them.

    503 if it lost its connections to a database that answers, which a restart repairs.
    """
    # Not as a dependency, which would need a free thread.
    if service_of(request).stores.monitor.broken.is_set():
        raise ProblemError(
            "unavailable", "The process lost its connections to the database and has to restart."
        )
    return Health()


@router.get("/readyz", responses=declared(*_LACKING))
async def readyz(service: CurrentService) -> Health:
    """Database, file storage and queue respond, so jobs can be submitted. 503 once the service is stopping."""
    await _require_everything(service)
    return Health()


@router.get("/startupz", responses=declared(*_LACKING))
async def startupz(service: CurrentService) -> Health:
    """The service has been ready once since its start; after that use `readyz`."""
    if not service.started.is_set():
        await _require_everything(service)
    return Health()


async def _require_everything(service: Service) -> None:
    if service.closing.is_set():
        raise ProblemError("unavailable", "The service is stopping.")
    lacking = await service.stores.monitor.lacking()
    if not lacking:
        service.started.set()
        return
    need = min(lacking, key=_NEEDS.index)
    found = [FieldProblem(pointer=f"check/{name}", detail=why) for name, why in lacking.items()]
    raise ProblemError(f"{need}_unavailable", lacking[need], errors=found)


@router.get(
    "/metrics",
    response_class=PlainTextResponse,
    responses={
        200: {
            "description": "Prometheus' text format, or OpenMetrics if `Accept` asks for it.",
            "content": {
                "text/plain": {"schema": {"type": "string"}, "example": "biresnerf_database_up 1.0\n"}
            },
        },
        **declared("metrics_token_required", "database_unavailable"),
    },
)
async def get_metrics(
    request: Request,
    service: CurrentService,
    accept: Annotated[str, Header()] = "",
    _authorization: Annotated[
        str,
        Header(alias="authorization", description="`Bearer` and BIRESNERF_METRICS_TOKEN, or an admin key."),
    ] = "",
) -> Response:
    """Metrics of this process and of the installation; without the database only of this process."""
    if not await may_scrape(service, request):
        # Metrics reveal what the service does, so not everyone who can reach the port may read them.
        raise ProblemError(
            "metrics_token_required",
            "The token of /metrics is missing, wrong, or not set.",
            hint="Set BIRESNERF_METRICS_TOKEN and send it as Authorization: Bearer; an admin key does too.",
            headers={"WWW-Authenticate": "Bearer"},
        )
    try:
        installation = await service.stores.monitor.statistics()
    except Unavailable:
        installation = None
    text, media_type = Exposition(service.metrics, installation).rendered(accept)
    return Response(text, media_type=media_type, headers={"Cache-Control": "no-store"})

"""Information about the service: version, limits, options of jobs, usage, and the operator's view."""

from __future__ import annotations

import csv
import hashlib
import io
from datetime import UTC, date, datetime
from typing import Annotated, Any, Literal, get_args

from fastapi import APIRouter, Header, Query, Response

from biresnerf import __version__
from biresnerf.options.presets import PRESETS
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.operator import OperatorView
from biresnerf.wire.service import Info, OptionsView, SizeLimits, UsageKey, UsageList, UsageRow
from service.http.access import Admin, ReadCaller
from service.http.dependencies import IfNoneMatch
from service.http.http_conditionals import none_match
from service.http.problems import wrong_field
from service.intake.archive_import import RATIO_MAX

router = APIRouter(tags=["service"])
CSV = "text/csv"
USAGE_ROWS_MAX = 10_000
_ROWS: dict[int | str, dict[str, Any]] = {
    200: {
        "model": UsageList,
        "content": {
            CSV: {
                "schema": {"type": "string"},
                "example": f"{','.join(UsageRow.model_fields)}\r\n2026-01-31,,,,3,41.5,22.0,0.0\r\n",
            }
        },
    }
}
ARCHIVES = ["application/zip", "application/x-tar", "application/gzip"]


@router.get("/v1/options", response_model=OptionsView, responses={304: {"description": "Not modified."}})
async def get_options(
    response: Response, _: ReadCaller, if_none_match: IfNoneMatch = None
) -> OptionsView | Response:
    """JSON Schema of the options, and the presets with every value filled in."""
    view = OptionsView(
        json_schema=RefineOptions.model_json_schema(),
        presets={name: RefineOptions(preset=name).resolved("cpu") for name in PRESETS},
        presets_on_gpu={name: RefineOptions(preset=name).resolved("cuda") for name in PRESETS},
    )
    etag = f'"{hashlib.sha256(view.model_dump_json().encode()).hexdigest()[:32]}"'
    headers = {"ETag": etag, "Cache-Control": "max-age=300"}
    if not none_match(if_none_match, etag):
        return Response(status_code=304, headers=headers)
    response.headers.update(headers)
    return view


@router.get("/v1/info")
async def get_info(caller: ReadCaller) -> Info:
    """Version, limits and workers of this service, your key's scopes, your share, and your jobs by state."""
    limits = {
        name: getattr(caller.service.settings, name)
        for name in SizeLimits.model_fields
        if name != "max_archive_ratio"
    }
    return Info(
        version=__version__,
        limits=SizeLimits(**limits, max_archive_ratio=RATIO_MAX),
        archives=ARCHIVES,
        job_counts=await caller.jobs.counts(),
        workers=await caller.service.stores.monitor.living_workers(),
        scopes=sorted(caller.scopes),
        share=await caller.service.stores.tenants.share(caller.tenant),
    )


@router.get("/v1/usage", response_class=Response, responses=_ROWS)
async def get_usage(
    caller: ReadCaller,
    first: Annotated[
        date | None, Query(alias="from", description="A day of UTC. Default: 30 days before `to`.")
    ] = None,
    last: Annotated[date | None, Query(alias="to", description="The last day. Default: today.")] = None,
    by: Annotated[
        str,
        Query(
            max_length=30, description="Some of `day`, `tenant`, `key` and `device`.", examples=["day,key"]
        ),
    ] = "day",
    form: Annotated[
        Literal["json", "csv"] | None, Query(alias="format", description="Default: as `Accept` says.")
    ] = None,
    accept: Annotated[str, Header()] = "",
) -> Response:
    """Processor and GPU seconds of attempts that ended on these days.

    Counts your tenant's attempts; with the scope `admin`, those of all tenants.
    """
    keys = [key for key in get_args(UsageKey) if key in by.split(",")]
    if len(keys) != len(by.split(",")):
        raise wrong_field("/query/by", f"These are not some of {', '.join(get_args(UsageKey))}, each once.")
    last = last or datetime.now(UTC).date()
    first = first or date.fromordinal(max(1, last.toordinal() - 30))
    tenant = None if "admin" in caller.scopes else caller.tenant
    rows = await caller.service.stores.tenants.usage(first, last, keys, tenant, USAGE_ROWS_MAX + 1)
    if len(rows) > USAGE_ROWS_MAX:
        raise wrong_field("/query/by", f"These are more than {USAGE_ROWS_MAX} rows; ask for fewer days.")
    if (form or ("csv" if CSV in accept else "json")) == "json":
        return Response(UsageList(items=rows).model_dump_json(), media_type="application/json")
    text = io.StringIO()
    table = csv.DictWriter(text, list(UsageRow.model_fields))
    table.writeheader()
    table.writerows(row.model_dump() for row in rows)
    return Response(text.getvalue(), media_type=CSV)


@router.get("/v1/operator")
async def get_operator_view(caller: Admin, response: Response) -> OperatorView:
    """The installation's state over all tenants: queue, slots and their jobs, sizes, and the latest failures."""
    response.headers["Cache-Control"] = "no-store"
    seen = await caller.service.stores.monitor.overview()
    return seen.model_copy(update={"upload_room_bytes": caller.service.disk_budget.free_bytes()})

"""Version and limits of the service, and the options of jobs."""

from __future__ import annotations

import hashlib

from fastapi import APIRouter, Response

from biresnerf import __version__
from biresnerf.options.presets import PRESETS
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.service import Info, OptionsView, SizeLimits
from service.http.access import ReadCaller
from service.http.dependencies import IfNoneMatch
from service.http.http_conditionals import none_match
from service.intake.archive_import import RATIO_MAX

router = APIRouter(tags=["service"])
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

"""The files of a result: list, download whole or in part."""

from __future__ import annotations

from urllib.parse import quote

from fastapi import APIRouter
from fastapi.responses import Response, StreamingResponse

from biresnerf.comparison.conclusion import Comparison
from biresnerf.report import Report
from biresnerf.wire.jobs import job_url
from biresnerf.wire.results import ArtifactList, ArtifactView
from service.http.access import Caller, ReadCaller
from service.http.dependencies import JobId
from service.http.problems import ProblemError, declared
from service.intake.result_comparison import ResultFiles, compared
from service.responses.downloads import (
    DOWNLOAD_RESPONSES,
    DownloadConditions,
    artifact_response,
    find_artifact,
)
from workers.records import Artifact

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["results"])
REPORT, POSES = "report.json", "poses.json"


@router.get("/artifacts", responses=declared("expired"))
async def list_artifacts(job_id: JobId, caller: ReadCaller) -> ArtifactList:
    """All files of the result and of its exports. While the job runs: previews of poses and a render."""
    found = await caller.jobs.artifacts(job_id)
    items = [
        ArtifactView(
            **artifact.model_dump(exclude={"key"}),
            preview=artifact.preview,
            href=f"{job_url(job_id)}/artifacts/{quote(artifact.name)}",
        )
        for artifact in found
    ]
    return ArtifactList(items=items)


@router.get("/artifacts/{name:path}", response_class=StreamingResponse, responses=DOWNLOAD_RESPONSES)
@router.head("/artifacts/{name:path}", response_class=StreamingResponse, responses=DOWNLOAD_RESPONSES)
async def get_artifact(
    job_id: JobId, name: str, caller: ReadCaller, conditions: DownloadConditions
) -> Response:
    """One file. Its strong ETag is the SHA-256 of its bytes.

    If files are stored in a bucket and the operator has enabled it, the response is a redirect to the bucket.
    """
    artifact = await find_artifact(caller.jobs, job_id, name)
    return await artifact_response(caller.service, artifact, conditions)


@router.get("/report", response_model=Report, responses=declared("expired", "result_not_ready"))
async def get_report(job_id: JobId, caller: ReadCaller) -> Response:
    """The machine-readable report of a finished job (the artifact `report.json`)."""
    artifact = await find_report(caller, job_id)
    content = await whole_file(caller, artifact)
    return Response(content, media_type="application/json", headers={"ETag": f'"{artifact.sha256}"'})


@router.get("/comparison/{other_id}", responses=declared("expired", "result_not_ready", "state_conflict"))
async def compare_jobs(job_id: JobId, other_id: JobId, caller: ReadCaller) -> Comparison:
    """Compares two results: which is better, this job's (`first`) or the other one's (`second`), and by which measure.

    The comparison is about the returned poses; it reads both jobs' `report.json` and `poses.json`.
    """
    first, second = [await _result_files(caller, each) for each in (job_id, other_id)]
    return await compared(caller, first, second)


async def _result_files(caller: Caller, job_id: str) -> ResultFiles:
    report = await find_report(caller, job_id)
    poses = await find_artifact(caller.jobs, job_id, POSES)
    texts = [(await whole_file(caller, each)).decode() for each in (report, poses)]
    return ResultFiles(report=texts[0], poses=texts[1])


async def find_report(caller: Caller, job_id: str) -> Artifact:
    """The report's file; raises `ProblemError` (``result_not_ready``, ``not_found``)."""
    try:
        return await find_artifact(caller.jobs, job_id, REPORT)
    except ProblemError:
        job = await caller.jobs.get(job_id)
        code = "not_found" if job.final else "result_not_ready"
        detail = f"The job {job.state} without a report." if job.final else f"The job is {job.state}."
        raise ProblemError(code, detail) from None


async def whole_file(caller: Caller, artifact: Artifact) -> bytes:
    """The content of a small file."""
    return b"".join([chunk async for chunk in caller.service.stores.files.read(artifact.key)])

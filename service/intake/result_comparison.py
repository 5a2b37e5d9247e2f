"""Compares two results in a child program: poses need NumPy, which the web process never loads.

The child is `python -m service.intake.result_comparison`.
"""

from __future__ import annotations

from typing import Any

from biresnerf.comparison.conclusion import Comparison
from biresnerf.frozen_model import FrozenModel
from service.http.access import Caller
from service.http.problems import ProblemError
from service.intake.sandboxed_child import Limits, run_child, run_confined

_SECONDS, _FILE_BYTES = 60.0, 1  # it writes no file


class ResultFiles(FrozenModel):
    """The content of a result's report.json and poses.json."""

    report: str
    poses: str


class CompareRequest(FrozenModel):
    """What to compare."""

    first: ResultFiles
    second: ResultFiles


async def compared(caller: Caller, first: ResultFiles, second: ResultFiles) -> Comparison:
    """The comparison; raises `ProblemError` (``state_conflict``: a file is of another version)."""
    service = caller.service
    limits = Limits(seconds=_SECONDS, memory_bytes=service.memory.picture, file_bytes=_FILE_BYTES)
    async with service.decoding.turn(caller.tenant):
        request = CompareRequest(first=first, second=second)
        answer = await run_confined("service.intake.result_comparison", request, limits)
    if answer["comparison"] is None:
        detail = "A result was written by another version, or holds no poses: it cannot be compared."
        raise ProblemError("state_conflict", detail)
    return Comparison.model_validate(answer["comparison"])


def compare(request: dict[str, Any]) -> dict[str, Any]:
    """The comparison; None if a file is of another version or holds no poses."""
    from biresnerf.comparison.compare_results import compare_results
    from biresnerf.data.formats.simple.poses_json import PosesDocument
    from biresnerf.report import Report

    files = CompareRequest.model_validate(request)
    try:
        first, second = (
            (Report.model_validate_json(each.report), PosesDocument.model_validate_json(each.poses))
            for each in (files.first, files.second)
        )
    except ValueError:
        return {"comparison": None}
    return {"comparison": compare_results(first, second).model_dump(mode="json")}


if __name__ == "__main__":
    run_child(compare)

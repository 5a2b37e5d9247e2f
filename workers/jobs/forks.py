"""Which work of a job a fork can take over, given the options that change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from biresnerf.options.refine_options import OPTIONS, STAGE_1_OPTIONS, RefineOptions, parse_options
from biresnerf.stages import REUSABLE_STAGES, ReusableStage
from biresnerf.wire.jobs import WantedStage
from workers.settings.errors import Conflict

LATEST_FIRST = REUSABLE_STAGES[::-1]


def plan_fork(
    parent: Mapping[str, Any], changes: Mapping[str, Any], wanted: WantedStage
) -> tuple[RefineOptions, ReusableStage]:
    """Options of the fork, and the latest stage that it can take over.

    Args:
        parent: the row of the forked job.
        changes: options that change; all others stay as requested.
        wanted: a stage, or ``auto`` for the latest that the changes allow.

    Raises:
        Conflict: ``fork_not_possible``, with the reason.
        InputError: ``invalid_options``.
    """
    # Sizes that ran out of memory would do so again.
    asked = {**parent["options"], **parent["smaller"]}
    options = parse_options({**asked, **changes})
    # Without resolved options the job has not run, and there is nothing to take over on any device.
    device = (parent["resolved_options"] or {}).get("device", "cpu")
    old = parse_options(asked).resolved(device).model_dump()
    new = options.resolved(device if options.device == "auto" else options.device).model_dump()
    changed = {name for name in new if new[name] != old[name]}
    reasons = []
    for stage in LATEST_FIRST if wanted == "auto" else (wanted,):
        reason = _why_not(stage, parent["reusable"], changed, new)
        if reason is None:
            return options, stage
        reasons.append(reason)
    raise Conflict("fork_not_possible", " ".join(reasons))


def _why_not(
    stage: ReusableStage, reusable: Mapping[str, Any], changed: set[str], new: Mapping[str, Any]
) -> str | None:
    if stage == "coarse":
        if stage not in reusable:
            return "The job has not come to the end of stage 1."
        earlier = sorted(changed & STAGE_1_OPTIONS)
        return f"Stage 1 depends on {', '.join(earlier)}." if earlier else None
    if stage not in reusable:
        return "The job has no poses from COLMAP."
    if new["start"] not in ("auto", "colmap"):
        return f"start={new['start']} does not ask COLMAP."
    if "seeding_effort" in changed and new["seeding_effort"] == "full":
        return "COLMAP's answer was found with seeding_effort=low."
    checked_above = {"start", "seeding_effort"}
    others = sorted(name for name in changed - checked_above if OPTIONS[name].stage == "seeding")
    return f"COLMAP's answer depends on {', '.join(others)}." if others else None

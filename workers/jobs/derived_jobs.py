"""Jobs derived from another: forks that start from its work, and exports of its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from psycopg.types.json import Jsonb

from biresnerf.options.formats import ExportName, PosesOf
from biresnerf.options.refine_options import OPTIONS, STAGE_1_OPTIONS, RefineOptions, parse_options
from biresnerf.stages import REUSABLE_STAGES, ReusableStage
from biresnerf.wire.base import Page
from biresnerf.wire.jobs import JobKind, JobView, WantedStage
from workers.database.database import Connection
from workers.database.ids import new_id
from workers.jobs.job_rows import JOB, asked_columns, fingerprint_of, job_from_row, known_job, require_result
from workers.jobs.job_states import insert_job, queue_job
from workers.jobs.jobs import JobStore
from workers.jobs.quotas import require_room, submitting_for
from workers.records import PRIORITIES
from workers.settings.errors import Conflict
from workers.store.files import FileStore
from workers.store.trash import discard, rescue

NORMAL = PRIORITIES["normal"]
LATEST_FIRST = REUSABLE_STAGES[::-1]
# When copies for a fork that was never created are deleted; far longer than a request takes.
ABANDONED_S = 3600


class DerivedJobs(JobStore):
    """The job store, extended by derived jobs. Every method raises `NotFound` as well."""

    def __init__(self, jobs: JobStore, files: FileStore) -> None:
        super().__init__(jobs._database, jobs._listener, jobs._settings)
        self._files, self._tenant, self._key_id = files, jobs._tenant, jobs._key_id

    async def fork(
        self,
        job_id: str,
        changes: Mapping[str, Any],
        wanted: WantedStage = "auto",
        *,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
    ) -> tuple[JobView, bool]:
        """Queue a job on the same dataset with other options, reusing a stage's work.

        It gets its own copy of that work, so that either job can be deleted. Returns the job and whether it is
        new (False: the same key with the same request came before).
        Raises `Conflict` (``fork_not_possible``, ``dataset_not_ready``, ``idempotency_key_reused``),
        `InputError` (``invalid_options``), `LimitReached` (``queue_full``).
        """
        async with self._database.transaction() as connection:
            parent = await self._required(connection, job_id)
            if parent["kind"] != "refine":
                raise Conflict("fork_not_possible", f"{job_id} is an export.")
            if parent["fixed_from"] is not None:
                require_result(await self._required(connection, parent["fixed_from"]))
            options, stage = plan_fork(parent, changes, wanted)
            asked = asked_columns(options)
            fingerprint = fingerprint_of(f"fork {job_id} {stage}", options.model_dump(mode="json"), labels)
            # Checked before copying: no quota counts the copies until the fork exists.
            known = await self._existing_after_quota(connection, parent, idempotency_key, fingerprint)
            if known is not None:
                return known, False
        fork_id = new_id("job")
        copied = await self._copied(parent["reusable"], stage, fork_id)
        async with self._database.transaction() as connection:
            known = await self._existing_after_quota(connection, parent, idempotency_key, fingerprint)
            if known is not None:
                return known, False
            values = {
                **asked,
                "labels": Jsonb(dict(labels or {})),
                "idempotency_key": idempotency_key,
                "fingerprint": fingerprint,
                "reusable": Jsonb(copied),
                "forked_from": job_id,
                "fixed_from": parent["fixed_from"],
                "forked_stage": stage,
            }
            await rescue(connection, f"jobs/{fork_id}")
            return await self._insert_below(connection, parent, fork_id, values), True

    async def _existing_after_quota(
        self,
        connection: Connection,
        parent: Mapping[str, Any],
        idempotency_key: str | None,
        fingerprint: str,
    ) -> JobView | None:
        """The job of an earlier request with this key, else None; raises if there is no room for a new one."""
        await submitting_for(connection, {parent["dataset_id"]}, self._tenant)
        if idempotency_key is not None:
            known = await known_job(connection, parent["tenant"], idempotency_key, fingerprint)
            if known is not None:
                return known
        await require_room(connection, parent["dataset_id"], NORMAL, self._settings.max_queued)
        return None

    async def _copied(
        self, reusable: Mapping[str, Any], stage: ReusableStage, fork_id: str
    ) -> dict[str, Any]:
        """Copy the work of a stage and those before it for the fork; it is trash until the fork exists."""
        async with self._database.transaction() as connection:
            await discard(connection, f"jobs/{fork_id}", after_s=ABANDONED_S)
        copied: dict[str, Any] = {}
        for name in LATEST_FIRST[LATEST_FIRST.index(stage) :]:
            if name not in reusable:
                continue
            source, target = reusable[name]["prefix"], f"jobs/{fork_id}/taken/{name}"
            for file in reusable[name]["files"]:
                await self._files.copy(f"{source}/{file}", f"{target}/{file}")
            copied[name] = {"prefix": target, "files": reusable[name]["files"]}
        return copied

    async def export(
        self, job_id: str, formats: Sequence[ExportName], poses_of: PosesOf = "camera"
    ) -> tuple[JobView, bool]:
        """Queue an export of the job's result in more formats; the same request returns the same export.

        Raises `Conflict` (``result_not_ready``; ``state_conflict``: there are no poses to export),
        `LimitReached` (``queue_full``).
        """
        options: dict[str, Any] = {"formats": sorted(set(formats))}
        if poses_of != "camera":
            options["poses_of"] = poses_of
        fingerprint = fingerprint_of(f"export {job_id}", options)
        async with self._database.transaction() as connection:
            parent = await self._required(connection, job_id)
            require_result(parent)
            await submitting_for(connection, {parent["dataset_id"]}, self._tenant)
            same = await connection.row(
                JOB + " WHERE parent = %s AND fingerprint = %s AND kind = 'export'"
                " AND state IN ('queued', 'running', 'succeeded')",
                job_id,
                fingerprint,
            )
            if same is not None:
                return job_from_row(same), False
            await require_room(connection, parent["dataset_id"], NORMAL, self._settings.max_queued)
            values = {
                "kind": "export",
                "parent": job_id,
                "options": Jsonb(options),
                "fingerprint": fingerprint,
            }
            return await self._insert_below(connection, parent, new_id("exp"), values), True

    async def exports(self, job_id: str) -> Page[JobView]:
        """All exports of a job, the oldest first."""
        async with self._database.transaction() as connection:
            await self._required(connection, job_id)
            return await _below(connection, job_id, "export")

    async def parts(self, job_id: str) -> Page[JobView]:
        """The jobs that a job has split itself into, in order; none for most jobs."""
        async with self._database.transaction() as connection:
            await self._required(connection, job_id)
            return await _below(connection, job_id, "refine")

    async def _insert_below(
        self, connection: Connection, parent: Mapping[str, Any], job_id: str, values: Mapping[str, Any]
    ) -> JobView:
        """A queued job on the dataset of ``parent``, for its tenant."""
        own = {"id": job_id, "key_id": self._key_id}
        row = {**own, "dataset_id": parent["dataset_id"], "tenant": parent["tenant"], **values}
        await queue_job(connection, await insert_job(connection, row))
        return job_from_row(await self._required(connection, job_id))


async def _below(connection: Connection, job_id: str, kind: JobKind) -> Page[JobView]:
    sql = JOB + " WHERE parent = %s AND kind = %s ORDER BY created_at, id"
    return Page(items=tuple(map(job_from_row, await connection.rows(sql, job_id, kind))))


def plan_fork(
    parent: Mapping[str, Any], changes: Mapping[str, Any], wanted: WantedStage
) -> tuple[RefineOptions, ReusableStage]:
    """The options of the fork, and the latest stage that it can reuse.

    Args:
        parent: the row of the forked job.
        changes: options that change; all others stay as requested.
        wanted: a stage, or ``auto`` for the latest that the changes allow.

    Raises:
        Conflict: ``fork_not_possible``, with the reason.
        InputError: ``invalid_options``.
    """
    # The larger sizes would run out of memory again.
    asked = {**parent["options"], **parent["smaller"]}
    options = parse_options({**asked, **changes})
    # Without resolved options the job has not run, and there is nothing to reuse on any device.
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

"""How a job ends in the database: the one place that writes a final state, for workers and the janitor alike.

Call within a transaction that holds the job's row lock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from psycopg.types.json import Jsonb

from biresnerf.wire.problems import JobError
from workers.database.database import Connection
from workers.records import LOG_NAME, POSES_NAME, PREVIEW_FOLDER, REPORT_NAME, Artifact

End = Literal["succeeded", "failed", "cancelled"]
STALL_S = 60.0


async def finish(
    connection: Connection,
    job_id: str,
    state: End,
    error: JobError | None,
    artifacts: Sequence[Artifact] = (),
    *,
    partial: bool = False,
) -> None:
    """Write the end and its event. Previews are over."""
    await connection.execute(
        "UPDATE jobs SET state = %s, error = %s, artifacts = %s, finished_at = clock_timestamp(),"
        " eta_s = NULL, fraction = CASE WHEN %s = 'succeeded' THEN 1 ELSE fraction END,"
        " partial = %s, previews = NULL WHERE id = %s",
        (
            *(state, Jsonb(error.model_dump()) if error else None),
            *(Jsonb([item.model_dump() for item in artifacts]), state, partial, job_id),
        ),
    )
    data: dict[str, Any] = {"code": error.code, "detail": error.detail} if error else {}
    if state == "cancelled":
        data = {"partial": partial}
    await connection.execute("SELECT add_job_event(%s, %s, %s)", (job_id, state, Jsonb(data)))


async def finish_cancelled(
    connection: Connection,
    job_id: str,
    artifacts: Sequence[Artifact] = (),
    keep: str | None = None,
    stall_s: float = STALL_S,
) -> None:
    """End a job on request, with what its user wants of the files: all there are, or the log alone.

    Where a partial result is wanted and the process did not come to write one, the last preview is it.

    Args:
        artifacts: what the attempt could store.
        keep: the attempt's name.
        stall_s: how long a worker may be silent; nothing is deleted before twice that.
    """
    cursor = await connection.execute("SELECT keep_partial, previews FROM jobs WHERE id = %s", (job_id,))
    row = await cursor.fetchone()
    assert row is not None, "the row is locked"
    logs = [item for item in artifacts if item.name == LOG_NAME]
    kept, shown = list(artifacts), None
    if row["keep_partial"] and not _is_whole(kept) and row["previews"] is not None:
        shown = row["previews"]["prefix"].rpartition("/")[2]
        kept = logs + [
            item.model_copy(update={"name": item.name.removeprefix(f"{PREVIEW_FOLDER}/")})
            for item in map(Artifact.model_validate, row["previews"]["artifacts"])
        ]
    partial = row["keep_partial"] and _is_whole(kept)
    await finish(connection, job_id, "cancelled", None, kept if partial else logs, partial=partial)
    await trash_attempts(connection, job_id, keep, stall_s, preview=shown)


def _is_whole(artifacts: Sequence[Artifact]) -> bool:
    """Whether there are poses and the report on them, which is written last: a process may have been killed between."""
    return {POSES_NAME, REPORT_NAME} <= {item.name for item in artifacts}


async def trash_attempts(
    connection: Connection,
    job_id: str,
    keep: str | None,
    stall_s: float = STALL_S,
    *,
    preview: str | None = None,
) -> None:
    """Give to the trash what attempts left, except the results of ``keep`` and the preview named ``preview``."""
    # Twice the stall time: a frozen owner that wakes up later finds itself fenced at its first write.
    await connection.execute(
        "INSERT INTO trash (prefix, keep, not_before)"
        " SELECT prefix, keep, clock_timestamp() + make_interval(secs => %s)"
        " FROM (VALUES (%s, NULL), (%s, %s), (%s, %s)) AS garbage (prefix, keep)",
        (
            *(2 * stall_s, f"jobs/{job_id}/checkpoints", f"jobs/{job_id}/results", keep),
            *(f"jobs/{job_id}/previews", preview),
        ),
    )

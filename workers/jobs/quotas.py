"""Quotas of tenants, checked in the transaction that uses them, so that only one request gets the last place."""

from __future__ import annotations

from collections.abc import Collection

from workers.database.database import Connection
from workers.settings.errors import Conflict, LimitReached, NotFound


async def submitting_for(connection: Connection, dataset_ids: Collection[str], seen_by: str | None) -> str:
    """The tenant of the datasets; its submissions are serialized until the end of the transaction.

    So no two of them take its last place, or the same idempotency key. Other tenants do not wait, so the limit of the
    whole queue can be exceeded by as many jobs as are submitted concurrently.

    Raises `NotFound` if the tenant ``seen_by`` cannot see one of them.
    """
    # Datasets before the tenant, as uploads lock them.
    sql = "SELECT id, tenant FROM datasets WHERE id = ANY(%s) AND tenant = coalesce(%s, tenant) ORDER BY id FOR SHARE"
    rows = await connection.rows(sql, list(dataset_ids), seen_by)
    for missing in sorted(set(dataset_ids) - {row["id"] for row in rows}):
        raise NotFound(f"No dataset {missing}.")
    tenant = str(rows[0]["tenant"])
    await _lock_tenant(connection, tenant)
    return tenant


async def require_room(connection: Connection, dataset_id: str, priority: int, max_queued: int) -> None:
    """Check that one more job on the dataset is allowed.

    Raises `NotFound`, `Conflict` (``dataset_not_ready``, ``priority_not_allowed``), `LimitReached`
    (``queue_full``: ``max_queued`` jobs wait already; ``quota_exhausted``; ``daily_limit_reached``).
    """
    sql = "SELECT state, tenant FROM datasets WHERE id = %s FOR SHARE"
    dataset = await connection.required_row(f"No dataset {dataset_id}.", sql, dataset_id)
    if dataset["state"] != "ready":
        raise Conflict("dataset_not_ready", f"Dataset {dataset_id} is {dataset['state']}, not ready.")
    queued = await connection.value("SELECT count(*) FROM jobs WHERE state = 'queued'")
    if queued >= max_queued:
        raise LimitReached("queue_full", f"{queued} jobs wait already, which is the limit.")
    await _require_job_quota(connection, dataset["tenant"], priority)


async def _require_job_quota(connection: Connection, tenant: str, priority: int) -> None:
    limits = await _limits(connection, tenant)
    if priority > limits["top_priority"]:
        raise Conflict("priority_not_allowed", "Jobs of this tenant may not ask for so high a priority.")
    if limits["max_queued"]:
        waiting = "SELECT count(*) FROM jobs WHERE tenant = %s AND state = 'queued'"
        queued = await connection.value(waiting, tenant)
        if queued >= limits["max_queued"]:
            raise LimitReached("quota_exhausted", f"{queued} of your jobs wait already, which is the limit.")
    await _require_bytes(connection, tenant, limits["max_stored_bytes"], 1)
    if limits["max_daily_seconds"]:
        await _require_seconds(connection, tenant, limits["max_daily_seconds"])


async def _require_seconds(connection: Connection, tenant: str, limit: int) -> None:
    now = await connection.only_row(
        "SELECT seconds_today(%s) AS used, rfc3339(date_trunc('day', clock_timestamp(), 'UTC') + interval '1 day')"
        " AS reset_at",
        tenant,
    )
    if now["used"] >= limit:
        raise LimitReached(
            "daily_limit_reached",
            f"Your jobs have run for {now['used']:.0f} s today, and the limit max_daily_seconds is {limit}."
            f" It starts again at {now['reset_at']}.",
        )


async def require_byte_quota(connection: Connection, dataset_id: str, size: int) -> None:
    """Raises `LimitReached` (``quota_exhausted``) if the dataset's tenant may not store ``size`` more bytes.

    Locks the tenant's quotas until the end of the transaction.
    """
    tenant = await connection.value("SELECT tenant FROM datasets WHERE id = %s", dataset_id)
    if tenant is not None:
        limits = await _limits(connection, tenant)
        await _require_bytes(connection, tenant, limits["max_stored_bytes"], size)


async def _limits(connection: Connection, tenant: str) -> dict[str, int]:
    await _lock_tenant(connection, tenant)
    sql = "SELECT top_priority, max_queued, max_stored_bytes, max_daily_seconds FROM tenant_limits WHERE id = %s"
    return await connection.only_row(sql, tenant)


async def _lock_tenant(connection: Connection, tenant: str) -> None:
    await connection.execute("SELECT 1 FROM tenants WHERE id = %s FOR NO KEY UPDATE", (tenant,))


async def _require_bytes(connection: Connection, tenant: str, limit: int, size: int) -> None:
    if not limit:
        return
    stored = await connection.value("SELECT stored_bytes_of(%s)", tenant)
    if stored + size > limit:
        raise LimitReached(
            "quota_exhausted", f"{stored} of your {limit} bytes are stored; delete datasets or jobs first."
        )

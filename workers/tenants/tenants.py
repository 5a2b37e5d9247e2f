"""Tenants: the owners of datasets and jobs, with their shares of the service and their limits.

A store bound to a tenant sees nothing of others. The database itself keeps turns and limits (`give_turn` in its
schema), so they hold for every way to submit a job.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date

from psycopg import sql

from biresnerf.errors import InputError
from biresnerf.wire.jobs import PriorityName
from biresnerf.wire.service import TenantShare, UsageKey, UsageRow
from workers.database.database import Connection, Database
from workers.records import PRIORITIES, priority_name
from workers.settings.errors import NotFound
from workers.settings.settings import Settings

# The user of the machine; owns everything while no key is needed.
LOCAL_TENANT = "local"
TENANT_FORM = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")


class TenantStore:
    """Tenants in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) if the database does not answer.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    async def apply_defaults(self, settings: Settings) -> None:
        """Apply the settings' limits to all tenants without explicit ones."""
        values = (
            *(settings.tenant_max_running, settings.tenant_max_queued),
            *(settings.tenant_max_stored_bytes, settings.tenant_max_daily_seconds),
        )
        columns = "(max_running, max_queued, max_stored_bytes, max_daily_seconds)"
        await self._database.fetch(
            f"UPDATE tenant_defaults SET {columns} = (%s, %s, %s, %s) WHERE {columns} <> (%s, %s, %s, %s)",
            *(*values, *values),
        )

    async def share(self, tenant: str) -> TenantShare:
        """The tenant's share, limits and current use; raises `NotFound`."""
        shares = await self.shares(tenant)
        if not shares:
            raise NotFound(f"No tenant {tenant}.")
        return shares[0]

    async def shares(self, tenant: str | None = None) -> tuple[TenantShare, ...]:
        """All tenants, by name, or the given one."""
        rows = await self._database.fetch(
            "SELECT tenant_limits.*, coalesce(running, 0) AS running, coalesce(queued, 0) AS queued,"
            " stored_bytes_of(id) AS stored_bytes, seconds_today(id) AS seconds_today"
            " FROM tenant_limits LEFT JOIN tenant_jobs ON tenant = id"
            " WHERE id = coalesce(%s, id) ORDER BY id",
            tenant,
        )
        return tuple(
            TenantShare(**{**row, "top_priority": priority_name(row["top_priority"])}) for row in rows
        )

    async def usage(
        self,
        first: date,
        last: date,
        by: Sequence[UsageKey],
        tenant: str | None,
        limit: int,
    ) -> tuple[UsageRow, ...]:
        """Use by attempts that ended from ``first`` to ``last`` (UTC), of all tenants or one, summed ``by`` these."""
        columns = sql.SQL(", ").join(sql.Identifier("key_id" if key == "key" else key) for key in by)
        rows = await self._database.fetch(
            sql.SQL(
                "SELECT {columns}, sum(attempts)::bigint AS attempts, sum(processor_s) AS processor_s,"
                " sum(wall_s) AS wall_s, coalesce(sum(wall_s) FILTER (WHERE device = 'gpu'), 0) AS gpu_s"
                " FROM use_records WHERE day BETWEEN %s AND %s AND tenant = coalesce(%s, tenant)"
                " GROUP BY {columns} ORDER BY {columns} LIMIT %s"
            ).format(columns=columns),
            *(first, last, tenant, limit),
        )
        return tuple(UsageRow(**row) for row in rows)

    async def set(
        self,
        tenant: str,
        *,
        weight: float | None = None,
        top_priority: PriorityName | None = None,
        max_running: int | None = None,
        max_queued: int | None = None,
        max_stored_bytes: int | None = None,
        max_daily_seconds: int | None = None,
    ) -> TenantShare:
        """Change the given values (a limit of -1: back to the settings'); creates the tenant if needed.

        Raises `InputError` (``bad_tenant``).
        """
        top = None if top_priority is None else PRIORITIES[top_priority]
        async with self._database.transaction() as connection:
            await ensure_tenant(connection, tenant)
            await connection.execute(
                "UPDATE tenants SET weight = coalesce(%s, weight), top_priority = coalesce(%s, top_priority),"
                " max_running = nullif(coalesce(%s, max_running, -1), -1),"
                " max_queued = nullif(coalesce(%s, max_queued, -1), -1),"
                " max_stored_bytes = nullif(coalesce(%s, max_stored_bytes, -1), -1),"
                " max_daily_seconds = nullif(coalesce(%s, max_daily_seconds, -1), -1) WHERE id = %s",
                (weight, top, max_running, max_queued, max_stored_bytes, max_daily_seconds, tenant),
            )
            await connection.execute("SELECT offer_held(%s)", (tenant,))
        return await self.share(tenant)


def checked_tenant(name: str) -> str:
    """The name; raises `InputError` (``bad_tenant``) if it is not valid."""
    if not TENANT_FORM.fullmatch(name):
        raise InputError(
            "bad_tenant",
            "is no name of a tenant.",
            where=name[:100],
            hint="Use 1 to 63 lower-case letters, digits, - and _, the first a letter or digit.",
        )
    return name


async def ensure_tenant(connection: Connection, name: str) -> None:
    """Creates the tenant if it does not exist; raises `InputError` (``bad_tenant``)."""
    await connection.execute(
        "INSERT INTO tenants (id) VALUES (%s) ON CONFLICT DO NOTHING", (checked_tenant(name),)
    )

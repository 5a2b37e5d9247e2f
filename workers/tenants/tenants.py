"""Tenants: who owns datasets and jobs, what share of the service each gets, and how much of it at most.

A store bound to a tenant sees nothing of the others. Turns and limits are kept by the database itself
(`give_turn` in its schema), so they hold for every way a job comes in.
"""

from __future__ import annotations

import re

from biresnerf.errors import InputError
from biresnerf.wire.jobs import PriorityName
from biresnerf.wire.service import TenantShare
from workers.database.database import Connection, Database
from workers.records import PRIORITIES, priority_name
from workers.settings.errors import NotFound
from workers.settings.settings import Settings

# Whoever runs the machine; owns everything while no key is needed.
LOCAL_TENANT = "local"
TENANT_FORM = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")


class TenantStore:
    """Tenants in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) where the database does not answer.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    async def apply_defaults(self, settings: Settings) -> None:
        """Make the limits of the settings those of every tenant that has none of its own."""
        values = (settings.tenant_max_running, settings.tenant_max_queued, settings.tenant_max_stored_bytes)
        await self._database.fetch(
            "UPDATE tenant_defaults SET max_running = %s, max_queued = %s, max_stored_bytes = %s"
            " WHERE (max_running, max_queued, max_stored_bytes) <> (%s, %s, %s)",
            *(*values, *values),
        )

    async def share(self, tenant: str) -> TenantShare:
        """The tenant's share and use of it; raises `NotFound`."""
        shares = await self.shares(tenant)
        if not shares:
            raise NotFound(f"No tenant {tenant}.")
        return shares[0]

    async def shares(self, tenant: str | None = None) -> tuple[TenantShare, ...]:
        """All tenants, by name, or the one."""
        rows = await self._database.fetch(
            "SELECT tenant_limits.*, coalesce(running, 0) AS running, coalesce(queued, 0) AS queued,"
            " stored_bytes_of(id) AS stored_bytes FROM tenant_limits LEFT JOIN tenant_jobs ON tenant = id"
            " WHERE id = coalesce(%s, id) ORDER BY id",
            tenant,
        )
        return tuple(
            TenantShare(**{**row, "top_priority": priority_name(row["top_priority"])}) for row in rows
        )

    async def set(
        self,
        tenant: str,
        *,
        weight: float | None = None,
        top_priority: PriorityName | None = None,
        max_running: int | None = None,
        max_queued: int | None = None,
        max_stored_bytes: int | None = None,
    ) -> TenantShare:
        """Change what is given (a limit of -1: what the settings say again); makes the tenant if it is new.

        Raises `InputError` (``bad_tenant``).
        """
        top = None if top_priority is None else PRIORITIES[top_priority]
        async with self._database.transaction() as connection:
            await ensure_tenant(connection, tenant)
            await connection.execute(
                "UPDATE tenants SET weight = coalesce(%s, weight), top_priority = coalesce(%s, top_priority),"
                " max_running = nullif(coalesce(%s, max_running, -1), -1),"
                " max_queued = nullif(coalesce(%s, max_queued, -1), -1),"
                " max_stored_bytes = nullif(coalesce(%s, max_stored_bytes, -1), -1) WHERE id = %s",
                (weight, top, max_running, max_queued, max_stored_bytes, tenant),
            )
            await connection.execute("SELECT offer_held(%s)", (tenant,))
        return await self.share(tenant)


def checked_tenant(name: str) -> str:
    """The name; raises `InputError` (``bad_tenant``) where it cannot be one."""
    if not TENANT_FORM.fullmatch(name):
        raise InputError(
            "bad_tenant",
            "is no name of a tenant.",
            where=name[:100],
            hint="Use 1 to 63 lower-case letters, digits, - and _, the first a letter or digit.",
        )
    return name


async def ensure_tenant(connection: Connection, name: str) -> None:
    """Makes the tenant where there is none of that name; raises `InputError` (``bad_tenant``)."""
    await connection.execute(
        "INSERT INTO tenants (id) VALUES (%s) ON CONFLICT DO NOTHING", (checked_tenant(name),)
    )

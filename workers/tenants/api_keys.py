"""API keys: created, recognised, listed, revoked. Only their SHA-256 is stored."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable
from datetime import datetime, timedelta
from typing import Any, Literal, get_args

from pydantic import Field

from biresnerf.errors import InputError
from biresnerf.wire.base import Record
from workers.database.database import Database
from workers.database.ids import new_id
from workers.records import record_from_row
from workers.tenants.tenants import ensure_tenant
from workers.tenants.tokens import living_row, new_token

Scope = Literal["read", "datasets:write", "jobs:write", "admin"]
ALL_SCOPES: frozenset[Scope] = frozenset(get_args(Scope))
USUAL_SCOPES: tuple[Scope, ...] = ("read", "datasets:write", "jobs:write")
# Limits writes: not one per request of a busy client.
_USED_EVERY_S = 60
# How long "no key exists yet" is cached.
NONE_MADE_S = 1.0


class ApiKey(Record):
    """A key without its secret."""

    id: str
    tenant: str
    name: str
    prefix: str = Field(description="How the key begins; the rest is known to its holder alone.")
    scopes: tuple[Scope, ...]
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    last_used_at: datetime | None = Field(None, description="To the minute.")


class KeyRefused(Exception):
    """The key is unknown, expired or revoked. Says no more: a client must not learn which."""


class KeyStore:
    """Keys in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) if the database does not answer.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._any_made = False
        self._asked_at = -NONE_MADE_S
        self._asking: asyncio.Task[None] | None = None

    async def create(
        self, tenant: str, name: str, scopes: Iterable[Scope], *, lives: timedelta | None = None
    ) -> tuple[ApiKey, str]:
        """A new key and its text, which cannot be read again; creates the tenant if needed.

        Raises `InputError` (``bad_tenant``, ``bad_scope``).
        """
        wanted = sorted(set(scopes))
        if not wanted or not ALL_SCOPES.issuperset(wanted):
            raise InputError(
                "bad_scope",
                f"The scopes of a key are some of {', '.join(sorted(ALL_SCOPES))}.",
                where="scopes",
            )
        prefix, text, sha256 = new_token("brn")
        async with self._database.transaction() as connection:
            await ensure_tenant(connection, tenant)
            row = await connection.only_row(
                "INSERT INTO api_keys (id, tenant, name, prefix, sha256, scopes, expires_at)"
                " VALUES (%s, %s, %s, %s, %s, %s, clock_timestamp() + %s::interval) RETURNING *",
                *(new_id("key"), tenant, name, prefix, sha256, wanted, lives),
            )
        self._any_made = True
        return _key(row), text

    async def recognise(self, text: str) -> ApiKey:
        """The valid key with this text; records its use. Raises `KeyRefused`."""
        select = (
            "SELECT *, revoked_at IS NULL AND coalesce(expires_at > clock_timestamp(), true) AS living,"
            " coalesce(last_used_at < clock_timestamp() - make_interval(secs => %s), true) AS stale"
            " FROM api_keys WHERE prefix = %s"
        )
        row = await living_row(self._database, "brn", text, select, _USED_EVERY_S)
        if row is None:
            raise KeyRefused
        if row["stale"]:
            await self._database.fetch(
                "UPDATE api_keys SET last_used_at = clock_timestamp() WHERE id = %s", row["id"]
            )
        return _key(row)

    async def any_made(self) -> bool:
        """Whether a key was ever created. Revoked ones count: revoking the last must not open the service.

        Each request without a key calls this, so "yes" is cached forever and "no" for `NONE_MADE_S`.
        """
        if not self._any_made and time.monotonic() - self._asked_at >= NONE_MADE_S:
            if self._asking is None:  # one query for all concurrent callers
                self._asking = asyncio.create_task(self._ask())
            await asyncio.shield(self._asking)
        return self._any_made

    async def _ask(self) -> None:
        asked_at = time.monotonic()
        try:
            rows = await self._database.fetch("SELECT EXISTS (SELECT 1 FROM api_keys) AS any")
            self._any_made, self._asked_at = self._any_made or bool(rows[0]["any"]), asked_at
        finally:
            self._asking = None

    async def list(self, tenant: str | None = None) -> tuple[ApiKey, ...]:
        """The keys of a tenant, or all; oldest first."""
        rows = await self._database.fetch(
            "SELECT * FROM api_keys WHERE tenant = coalesce(%s, tenant) ORDER BY created_at, id", tenant
        )
        return tuple(_key(row) for row in rows)

    async def revoke(self, key_id: str) -> ApiKey:
        """Revoke a key for good, from the next request on; raises `NotFound`."""
        sql = "UPDATE api_keys SET revoked_at = coalesce(revoked_at, clock_timestamp()) WHERE id = %s RETURNING *"
        async with self._database.transaction() as connection:
            return _key(await connection.required_row(f"No key {key_id}.", sql, key_id))


def _key(row: dict[str, Any]) -> ApiKey:
    return record_from_row(ApiKey, row)

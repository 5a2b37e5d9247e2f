"""Keys that every replica must have alike and nobody else may know, kept in the database."""

from __future__ import annotations

import secrets

from workers.database.database import Database

KEY_BYTES = 32


async def shared_key(database: Database, name: str) -> bytes:
    """The key of that name, made by who asks first. Deleting its row makes a new one at the next start."""
    await database.fetch(
        "INSERT INTO server_secrets (name, value) VALUES (%s, %s) ON CONFLICT DO NOTHING",
        *(name, secrets.token_bytes(KEY_BYTES)),
    )
    rows = await database.fetch("SELECT value FROM server_secrets WHERE name = %s", name)
    return bytes(rows[0]["value"])

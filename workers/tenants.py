"""Tenants: who owns datasets and jobs. A store bound to one sees nothing of the others."""

from __future__ import annotations

import re

from biresnerf.errors import InputError
from workers.database import Connection

# Whoever runs the machine; owns everything while no key is needed.
LOCAL_TENANT = "local"
TENANT_FORM = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")


def checked_tenant(name: str) -> str:
    """The name; raises `InputError` (``bad_tenant``) where it cannot be one."""
    if not TENANT_FORM.fullmatch(name):
        raise InputError(
            "bad_tenant",
            "is no name of a tenant.",
            where=name[:100],
            mend="Use 1 to 63 lower-case letters, digits, - and _, the first a letter or digit.",
        )
    return name


async def ensure_tenant(connection: Connection, name: str) -> None:
    """Makes the tenant where there is none of that name; raises `InputError` (``bad_tenant``)."""
    await connection.execute(
        "INSERT INTO tenants (id) VALUES (%s) ON CONFLICT DO NOTHING", (checked_tenant(name),)
    )

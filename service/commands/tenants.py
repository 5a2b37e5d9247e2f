"""`biresnerf tenants`: each tenant's share of the service and its limits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.answers import json_option, show
from service.commands.installation import data_dir_option, with_database

if TYPE_CHECKING:
    from biresnerf.wire.service import TenantShare

_LIMIT = click.IntRange(min=-1)


@click.group("tenants")
def tenants_command() -> None:
    """List tenants and set their shares and limits.

    A limit of 0 means no limit; -1 means the default in BIRESNERF_TENANT_MAX_RUNNING, …_QUEUED, …_STORED_BYTES or
    …_DAILY_SECONDS.
    """


@tenants_command.command("list")
@json_option
@data_dir_option
def list_command(as_json: bool, data_dir: Path | None) -> None:
    """List the tenants with their usage."""
    from workers.tenants.tenants import TenantStore

    found = with_database(data_dir, lambda database: TenantStore(database).shares())
    show(found, "\n".join(map(_line, found)), as_json=as_json)


@tenants_command.command("set")
@click.argument("name")
@click.option(
    "--weight", type=click.FloatRange(0.1, 10), help="Share of the slots when several tenants wait."
)
@click.option(
    "--top-priority", type=click.Choice(["low", "normal", "high"]), help="Highest priority its jobs may have."
)
@click.option("--max-running", type=_LIMIT, help="Jobs running at the same time.")
@click.option("--max-queued", type=_LIMIT, help="Jobs waiting.")
@click.option("--max-stored-bytes", type=_LIMIT, help="Bytes of datasets, uploads and results.")
@click.option("--max-daily-seconds", type=_LIMIT, help="Seconds that its jobs may run in a day (UTC).")
@json_option
@data_dir_option
def set_command(name: str, as_json: bool, data_dir: Path | None, **changes: Any) -> None:
    """Change the given values of the tenant NAME; a new name creates a tenant."""
    from workers.tenants.tenants import TenantStore

    share = with_database(data_dir, lambda database: TenantStore(database).set(name, **changes))
    show(share, _line(share), as_json=as_json)


def _line(share: TenantShare) -> str:
    def used(now: int, limit: int) -> str:
        return f"{now} of {limit}" if limit else f"{now}"

    parts = (
        share.id,
        f"weight {share.weight:g}",
        f"up to {share.top_priority} priority",
        f"running {used(share.running, share.max_running)}",
        f"queued {used(share.queued, share.max_queued)}",
        f"bytes {used(share.stored_bytes, share.max_stored_bytes)}",
        f"seconds today {used(round(share.seconds_today), share.max_daily_seconds)}",
    )
    return "  ".join(parts)

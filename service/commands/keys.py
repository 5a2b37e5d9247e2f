"""`biresnerf keys`: create, list and revoke API keys, on the machine that holds the database."""

from __future__ import annotations

import re
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.answers import json_option, print_json, show
from biresnerf.errors import InputError
from service.commands.installation import data_dir_option, with_database

if TYPE_CHECKING:
    from workers.tenants.api_keys import ApiKey

_UNITS = {"h": "hours", "d": "days", "w": "weeks"}


class Span(click.ParamType):
    """Text such as 12h, 90d or 4w."""

    name = "span"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> timedelta:
        """The span; fails with the command's usage."""
        match = re.fullmatch(r"([1-9]\d{0,4})([hdw])", str(value))
        if match is None:
            self.fail(f"{value!r} is not of the form 12h, 90d or 4w", param, ctx)
        return timedelta(**{_UNITS[match[2]]: int(match[1])})


@click.group("keys")
def keys_command() -> None:
    """Create, list and revoke API keys.

    Works on the database at BIRESNERF_DATABASE_URL, or else on the private one of `biresnerf up`, which may be running
    or not.
    """


@keys_command.command("create")
@click.argument("name")
@click.option(
    "--tenant", default="local", show_default=True, help="The key's tenant; a new name creates a tenant."
)
@click.option(
    "--scope",
    "scopes",
    multiple=True,
    type=click.Choice(["read", "datasets:write", "jobs:write", "admin"]),
    help="May be repeated. Default: read, datasets:write and jobs:write. admin includes all.",
)
@click.option("--expires", type=Span(), help="For example 90d. Default: never.")
@json_option
@data_dir_option
def create_command(
    name: str,
    tenant: str,
    scopes: tuple[Any, ...],
    expires: timedelta | None,
    as_json: bool,
    data_dir: Path | None,
) -> None:
    """Create a key called NAME. Its text is shown once; only a digest of it is stored."""
    from workers.tenants.api_keys import USUAL_SCOPES, KeyStore

    key, text = with_database(
        data_dir,
        lambda database: KeyStore(database).create(tenant, name, scopes or USUAL_SCOPES, lives=expires),
    )
    if as_json:
        print_json({**key.model_dump(mode="json"), "key": text})
        return
    click.echo(text)
    click.echo(f"{_line(key)}\nKeep it now: it is not shown again.", err=True)


@keys_command.command("list")
@click.option("--tenant", help="Only keys of this tenant.")
@json_option
@data_dir_option
def list_command(tenant: str | None, as_json: bool, data_dir: Path | None) -> None:
    """List all keys, including revoked ones."""
    from workers.tenants.api_keys import KeyStore

    found = with_database(data_dir, lambda database: KeyStore(database).list(tenant))
    show(found, "\n".join(map(_line, found)), as_json=as_json)


@keys_command.command("revoke")
@click.argument("key_id")
@json_option
@data_dir_option
def revoke_command(key_id: str, as_json: bool, data_dir: Path | None) -> None:
    """Revoke the key KEY_ID for good, from its next request on."""
    from workers.settings.errors import NotFound
    from workers.tenants.api_keys import KeyStore

    try:
        key = with_database(data_dir, lambda database: KeyStore(database).revoke(key_id))
    except NotFound as error:
        raise InputError.of(error.fault, hint="`biresnerf keys list` shows the ids.") from None
    show(key, _line(key), as_json=as_json)


def _line(key: ApiKey) -> str:
    ends = f"revoked {key.revoked_at:%Y-%m-%d}" if key.revoked_at else "valid"
    if key.expires_at and not key.revoked_at:
        ends = f"until {key.expires_at:%Y-%m-%d}"
    used = f"used {key.last_used_at:%Y-%m-%d}" if key.last_used_at else "never used"
    parts = (key.id, key.prefix, key.tenant, ",".join(key.scopes), ends, used, key.name)
    return "  ".join(parts)

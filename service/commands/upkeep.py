"""The commands `dispatcher`, `backup` and `restore`; each imports what it needs when it runs."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from biresnerf.commands.answers import json_option, show
from service.commands.installation import data_dir_option, settings_with, setup_problems

if TYPE_CHECKING:
    from workers.upkeep.backup_folder import BackupIndex


@click.command("dispatcher")
def dispatcher_command() -> None:
    """Run the process that sends webhooks.

    Needs BIRESNERF_DATABASE_URL, and a database brought up to date by `biresnerf migrate`. Several may run. SIGTERM or
    Ctrl-C ends it after the deliveries under way.
    """
    from workers.upkeep.dispatcher import main

    with setup_problems():
        settings_with().require_database_url()
    sys.exit(main())


@click.command("backup")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@data_dir_option
@json_option
def backup_command(folder: Path, data_dir: Path | None, as_json: bool) -> None:
    """Back up the database and all files to FOLDER.

    The service may keep running. A further backup to FOLDER copies only new files. It holds secrets: protect it as
    well as the service.
    """
    from workers.database.reach_database import reached_database
    from workers.upkeep.backup import make_backup

    with setup_problems():
        settings = settings_with(data_dir=data_dir)
        with reached_database(settings) as url:
            index = asyncio.run(make_backup(settings, url, folder))
    _show_backup(index, as_json)
    if index.gone and not as_json:
        click.echo(f"Deleted by the service meanwhile: {len(index.gone)} files.")


@click.command("restore")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@data_dir_option
@json_option
def restore_command(folder: Path, data_dir: Path | None, as_json: bool) -> None:
    """Restore the backup in FOLDER into an empty installation.

    The service must not run yet. Every file is checked against its digest. Jobs that were running continue from their
    last checkpoints.
    """
    from workers.database.reach_database import reached_database
    from workers.upkeep.backup_folder import read_index
    from workers.upkeep.restore import restore_backup

    with setup_problems():
        settings = settings_with(data_dir=data_dir)
        read_index(folder)  # check the backup before a database is created
        with reached_database(settings, migrated=False) as url:
            index = asyncio.run(restore_backup(settings, url, folder))
    _show_backup(index, as_json)


def _show_backup(index: BackupIndex, as_json: bool) -> None:
    made_at, files, size = index.made_at, len(index.files), f"{index.bytes / 2**20:.1f} MiB"
    document = {
        "made_at": made_at.isoformat(), "files": files, "bytes": index.bytes, "gone": len(index.gone),
    }  # fmt: skip
    text = f"Backup of {made_at:%Y-%m-%d %H:%M:%S} UTC: database and {files} files, {size}."
    show(document, text, as_json=as_json)

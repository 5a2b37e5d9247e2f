"""The checks of `biresnerf doctor` for the service: its database, its disk, its page."""

from __future__ import annotations

import tempfile
from pathlib import Path

import psycopg
from pydantic import ValidationError

from biresnerf.commands.machine.machine_checks import Check, Found
from service.web_page import FOLDER
from workers.database.reach_database import reached_database
from workers.process.disk_space import DiskBudget
from workers.settings.errors import SetupError
from workers.settings.settings import Settings

_CONNECT_S = 10


def database() -> Found:
    """The configured database responds, or a private PostgreSQL starts."""
    try:
        settings = Settings()
    except ValidationError as error:
        return Found("settings", "broken", f"{error.error_count()} are invalid", "`biresnerf up` lists them.")
    # If root starts the database, it runs as another user, who must reach its folder.
    with tempfile.TemporaryDirectory(prefix="biresnerf-doctor-", ignore_cleanup_errors=True) as home:
        Path(home).chmod(0o711)
        try:
            with (
                reached_database(settings.model_copy(update={"data_dir": Path(home)}), migrated=False) as url,
                psycopg.connect(url, connect_timeout=_CONNECT_S) as connection,
            ):
                version = f"PostgreSQL {connection.info.server_version // 10_000}"
        except (SetupError, psycopg.Error) as error:
            return Found("database", "broken", str(error), "docs/operations.md")
    where = f"a private {version} starts"
    if settings.database_url is not None:
        where = f"{version} at BIRESNERF_DATABASE_URL"
    return Found("database", "good", where)


def disk() -> Found:
    """The disk space that uploads and jobs may still use."""
    try:
        settings = Settings()
    except ValidationError:
        return Found("service disk", "missing", "not checked: the settings are invalid")
    free = DiskBudget((settings.data_dir,), settings.disk_reserve_bytes).free_bytes()
    detail = f"{free / 2**30:.1f} GiB may be used in {settings.data_dir}"
    if free > 0:
        return Found("service disk", "good", detail)
    return Found(
        "service disk", "broken", detail, "Free some space, or set BIRESNERF_DATA_DIR to another folder."
    )


def page() -> Found:
    """The page at `/`."""
    if (FOLDER / "index.html").is_file():
        return Found("web page", "good", "built")
    return Found("web page", "missing", "is not built: only /docs and /v1 are available", "make web")


CHECKS: tuple[Check, ...] = (database, disk, page)

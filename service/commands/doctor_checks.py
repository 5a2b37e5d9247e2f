"""The checks of `biresnerf doctor` for the service: its database, its disk, its page."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import psycopg
from pydantic import ValidationError

from biresnerf.commands.machine.machine_checks import Check, Found
from service.web_page import FOLDER
from workers.database.embedded_postgres import EmbeddedPostgres
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
    try:
        if settings.database_url is not None:
            return _configured(settings.require_database_url())
        return _embedded()
    except (SetupError, psycopg.Error) as error:
        return Found("database", "broken", str(error), "docs/operations.md")


def _configured(url: str) -> Found:
    with psycopg.connect(url, connect_timeout=_CONNECT_S) as connection:
        return Found("database", "good", f"{_version(connection)} at BIRESNERF_DATABASE_URL")


def _embedded() -> Found:
    home = Path(tempfile.mkdtemp(prefix="biresnerf-doctor-"))
    home.chmod(0o711)  # if root starts the database, it runs as another user
    postgres = EmbeddedPostgres(home / "postgres")
    try:
        with psycopg.connect(postgres.start(), connect_timeout=_CONNECT_S) as connection:
            return Found("database", "good", f"a private {_version(connection)} starts")
    finally:
        postgres.stop()
        shutil.rmtree(home, ignore_errors=True)


def _version(connection: psycopg.Connection) -> str:
    return f"PostgreSQL {connection.info.server_version // 10_000}"


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

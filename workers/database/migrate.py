"""Brings a database up to date: the queue's schema and our numbered files, in one transaction.

Each release has a folder of files. They never change once it is out: the next release adds its own.
"""

from __future__ import annotations

import logging
import time
from importlib import resources

import psycopg

from workers.database import job_queue
from workers.settings.errors import SetupError

log = logging.getLogger(__name__)

# Any fixed number; two migrations that start together take turns on it.
MIGRATION_LOCK = 7_201_603


def migrate(database_url: str, *, wait_s: float = 30.0) -> list[str]:
    """Apply what is missing and return the names of the steps applied (none: it was up to date).

    Safe to call from many processes at once. Raises `SetupError` if the database does not answer within
    ``wait_s`` or was brought up by a newer version.
    """
    with _connect(database_url, wait_s) as connection:
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (MIGRATION_LOCK,))
        connection.execute(
            "CREATE TABLE IF NOT EXISTS schema_steps"
            " (name text PRIMARY KEY, applied_at timestamptz NOT NULL DEFAULT now())"
        )
        done = {row[0] for row in connection.execute("SELECT name FROM schema_steps")}
        queue, ours = job_queue.schema_steps(), _our_steps()
        steps = queue + ours
        unknown = sorted(done - {name for name, _ in steps})
        if unknown:
            raise SetupError(
                "database_newer",
                f"The database knows steps that this version lacks ({', '.join(unknown)}). "
                "Install the newer version.",
            )
        applied = []
        included = set() if done else {name for name, _ in queue[1:]}
        for name, sql in steps:
            if name not in done:
                if name not in included:
                    connection.execute(sql.encode())
                connection.execute("INSERT INTO schema_steps (name) VALUES (%s)", (name,))
                applied.append(name)
                log.info("applied %s", name)
        return applied


def step_names() -> list[str]:
    """The steps that this version knows, in order."""
    return [name for name, _ in (*job_queue.schema_steps(), *_our_steps())]


def _our_steps() -> list[tuple[str, str]]:
    folder = resources.files("workers.database").joinpath("migrations")
    releases = sorted(folder.iterdir(), key=lambda release: [int(part) for part in release.name.split(".")])
    return [
        (f"{release.name}/{file.name.removesuffix('.sql')}", file.read_text())
        for release in releases
        for file in sorted(release.iterdir(), key=lambda file: file.name)
    ]


def _connect(database_url: str, wait_s: float) -> psycopg.Connection:
    end = time.monotonic() + wait_s
    while True:
        try:
            return psycopg.connect(database_url, connect_timeout=5)
        except psycopg.OperationalError as error:
            if time.monotonic() >= end:
                raise SetupError(
                    "database_unreachable",
                    f"The database does not answer ({error}). Check BIRESNERF_DATABASE_URL.",
                ) from error
            time.sleep(0.2)

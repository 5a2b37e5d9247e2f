"""The database for a command that runs beside the service or without it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.settings.errors import SetupError
from workers.settings.settings import Settings


@contextmanager
def reached_database(settings: Settings, *, migrated: bool = True) -> Iterator[str]:
    """The address of the database: the one of the settings, or the private one of the data folder.

    A private one that runs already (below `biresnerf up`) is used as it is; else it is started for the time
    of the block. It is brought up to date first, unless ``migrated`` is off. Raises `SetupError`.
    """
    if settings.database_url is not None:
        if migrated:
            migrate(settings.database_url)
        yield settings.database_url
        return
    postgres = EmbeddedPostgres(settings.postgres_dir, pg_bin=settings.pg_bin)
    try:
        postgres.start()
    except SetupError as error:
        if error.code != "already_running":
            raise
    try:
        if migrated:
            migrate(postgres.url)
        yield postgres.url
    finally:
        postgres.stop()

"""The database for commands, whether or not the service is running."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.settings.errors import SetupError
from workers.settings.settings import Settings


@contextmanager
def reached_database(settings: Settings, *, migrated: bool = True) -> Iterator[str]:
    """The address of the settings' database, or of the private one in the data folder.

    A private one is started for the block unless it is running already (below `biresnerf up`). The database is migrated
    first, unless ``migrated`` is False. Raises `SetupError`.
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

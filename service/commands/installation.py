"""The settings and the database of this installation, for the operator's commands."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from biresnerf.errors import InputError

if TYPE_CHECKING:
    from workers.database.database import Database
    from workers.settings.settings import Settings

T = TypeVar("T")
data_dir_option = click.option(
    "--data-dir",
    type=click.Path(path_type=Path),
    help="Folder of files and private database. Default: BIRESNERF_DATA_DIR.",
)


def settings_with(**given: Any) -> Settings:
    """The settings of the environment, overridden by those given that are not None."""
    from workers.settings.settings import Settings

    return Settings(**{name: value for name, value in given.items() if value is not None})


@contextmanager
def setup_problems() -> Iterator[None]:
    """Turns invalid settings into an `InputError`."""
    from pydantic import ValidationError

    from workers.settings.errors import SetupError

    try:
        yield
    except SetupError as error:
        raise InputError.of(error.fault) from None
    except ValidationError as error:
        lines = [
            f"BIRESNERF_{'_'.join(map(str, item['loc'])).upper()}: {item['msg']}." for item in error.errors()
        ]
        raise InputError(
            "invalid_settings", " ".join(lines), hint="Change these environment variables."
        ) from None


def with_database(data_dir: Path | None, work: Callable[[Database], Awaitable[T]]) -> T:
    """Runs ``work`` on the configured database, or else on the private one; raises `InputError`."""
    from workers.database.database import open_database
    from workers.database.reach_database import reached_database

    async def run(url: str) -> T:
        async with open_database(url, connections=1) as database:
            return await work(database)

    with setup_problems(), reached_database(settings_with(data_dir=data_dir)) as url:
        return asyncio.run(run(url))

"""One place that opens what a process needs of the engine: `async with open_stores(settings) as stores`."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from workers.datasets import DatasetStore
from workers.files import FileStore
from workers.jobs import JobStore
from workers.settings import Settings


@dataclass(frozen=True)
class Stores:
    """The engine as the service sees it; open once per process."""

    jobs: JobStore
    datasets: DatasetStore
    files: FileStore


@asynccontextmanager
async def open_stores(settings: Settings) -> AsyncIterator[Stores]:
    """Connect pool, queue and listener; needs ``settings.database_url`` and a migrated database.

    Raises `SetupError`. Opening waits up to 30 s for the database.
    """
    raise NotImplementedError
    yield

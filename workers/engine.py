"""Opens the engine's stores for a process: `async with open_stores(settings) as stores`."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from workers.database.database import Database, open_database
from workers.datasets.datasets import DatasetStore
from workers.datasets.uploads import UploadStore
from workers.jobs.job_updates import JobListener
from workers.jobs.jobs import JobStore
from workers.jobs.result_links import ResultLinkStore
from workers.queue.janitor import Janitor
from workers.settings.settings import Settings
from workers.store.files import FileStore, open_files
from workers.store.store_identity import require_same_store
from workers.tenants.api_keys import KeyStore
from workers.tenants.tenants import TenantStore
from workers.tenants.token_buckets import TokenBuckets
from workers.upkeep.monitor import Monitor
from workers.webhooks.webhooks import WebhookStore

FOLLOW_POLL_S = 1.5
KEY_BYTES = 32


@dataclass(frozen=True)
class Stores:
    """The engine as the service sees it; open once per process."""

    jobs: JobStore
    datasets: DatasetStore
    files: FileStore
    uploads: UploadStore
    keys: KeyStore
    buckets: TokenBuckets
    tenants: TenantStore
    monitor: Monitor
    webhooks: WebhookStore
    janitor: Janitor  # not yet at work
    share_key: bytes  # signs links to files of results
    links: ResultLinkStore


@asynccontextmanager
async def open_stores(settings: Settings) -> AsyncIterator[Stores]:
    """Connect pool, queue and listener; needs ``settings.database_url`` of a migrated database.

    Raises `SetupError`. Opening waits up to 30 s for the database.
    """
    files = open_files(settings)
    async with open_database(
        settings.require_database_url(), silence_s=settings.stall_s, answer_s=settings.answer_s
    ) as database:
        await require_same_store(database, files)
        listener = JobListener(database, FOLLOW_POLL_S)
        listening = asyncio.create_task(listener.run())
        try:
            given = settings.share_key
            tenants = TenantStore(database)
            await tenants.apply_defaults(settings)
            yield Stores(
                jobs=JobStore(database, listener, settings),
                datasets=DatasetStore(database, files, settings),
                files=files,
                uploads=UploadStore(database, files, settings),
                keys=KeyStore(database),
                buckets=TokenBuckets(database),
                tenants=tenants,
                monitor=Monitor(database, files, settings.stall_s),
                webhooks=WebhookStore(database, settings),
                janitor=Janitor(database, files, settings),
                share_key=given.encode() if given else await _share_key(database),
                links=ResultLinkStore(database),
            )
        finally:
            listening.cancel()


async def _share_key(database: Database) -> bytes:
    """A key shared by all replicas; the first to ask creates it. Delete its row to get a new one at the next start."""
    await database.fetch(
        "INSERT INTO server_secrets (name, value) VALUES ('share', %s) ON CONFLICT DO NOTHING",
        secrets.token_bytes(KEY_BYTES),
    )
    (row,) = await database.fetch("SELECT value FROM server_secrets WHERE name = 'share'")
    return bytes(row["value"])

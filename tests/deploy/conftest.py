"""The engine's fixtures, for tests that run what the manifests say."""

from tests.workers.conftest import (
    anyio_backend,
    counting,
    database_url,
    scaler,
    server,
    settings,
    slots,
    stores,
)

__all__ = ["anyio_backend", "counting", "database_url", "scaler", "server", "settings", "slots", "stores"]

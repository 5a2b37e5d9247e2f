"""Dispatchers that may send to receivers on this machine."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.workers.conftest import Slots
from tests.workers.webhooks.webhook_receiver import Dispatchers, hook_settings
from workers.settings.settings import Settings


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    return hook_settings(database_url, tmp_path)


@pytest.fixture
async def dispatchers(settings: Settings, slots: Slots, tmp_path: Path) -> AsyncIterator[Dispatchers]:
    started = Dispatchers(settings, slots, tmp_path)
    yield started
    await started.end()

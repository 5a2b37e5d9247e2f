"""Silent workers soon count as dead."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.workers.conftest import SHORT_STALL, quick_settings
from workers.settings.settings import Settings


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    return quick_settings(tmp_path / "data", database_url=database_url, **SHORT_STALL)

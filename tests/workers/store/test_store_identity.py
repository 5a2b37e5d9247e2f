"""Processes of one installation see the same files, or do not start."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.workers.buckets import environment_of, fresh_bucket, moto_server
from tests.workers.conftest import quick_settings
from workers.engine import open_stores
from workers.settings.errors import SetupError
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


async def test_a_second_host_with_a_folder_of_its_own_refuses_to_start(settings: Settings, tmp_path: Path):
    async with open_stores(settings):
        pass
    elsewhere = quick_settings(tmp_path / "elsewhere", database_url=settings.database_url)
    for _ in range(2):
        with pytest.raises(SetupError, match="BIRESNERF_STORAGE_URL"):
            async with open_stores(elsewhere):
                pass
    async with open_stores(settings):
        pass
    (elsewhere.files_dir / "store-id").write_bytes((settings.files_dir / "store-id").read_bytes())
    async with open_stores(elsewhere):
        pass


async def test_a_bucket_is_known_again_from_any_host(settings: Settings, tmp_path: Path):
    with moto_server() as address:
        first, other = (environment_of(fresh_bucket(address)) for _ in range(2))
        for host in ("a", "b"):
            at = quick_settings(tmp_path / host, database_url=settings.database_url, **first)
            async with open_stores(at) as stores:
                assert await stores.files.healthy()
            assert not at.files_dir.exists()
        wrong = quick_settings(tmp_path / "c", database_url=settings.database_url, **other)
        with pytest.raises(SetupError) as caught:
            async with open_stores(wrong):
                pass
        assert caught.value.code == "storage_of_another"


async def test_a_store_with_a_past_is_taken_over_by_a_fresh_database(settings: Settings):
    settings.files_dir.mkdir(parents=True)
    (settings.files_dir / "store-id").write_text("restored")
    async with open_stores(settings):
        pass
    (settings.files_dir / "store-id").write_text("another")
    with pytest.raises(SetupError, match="expected restored"):
        async with open_stores(settings):
            pass

"""Programs that read strangers' files take less than their container has, also side by side."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from tests.workers.conftest import quick_settings
from tests.workers.datasets.test_checks import chunks
from tests.workers.datasets.test_checks import open_stores as opened
from workers.datasets import dataset_check
from workers.process.memory_limits import (
    CHECK_BYTES,
    CHECK_VARIABLE,
    PICTURE_BYTES,
    WEB_BYTES,
    memory_shares,
)

MIB, GIB = 2**20, 2**30


@pytest.mark.parametrize("processes", [1, 2, 4])
@pytest.mark.parametrize("gib", [1.5, 2, 3, 4, 8, 16, 64])
def test_all_programs_at_once_fit_beside_their_web_processes(gib: float, processes: int) -> None:
    limit = int(gib * GIB) * processes
    shares = memory_shares(limit, processes)
    one = WEB_BYTES + shares.check + shares.picture * shares.pictures + shares.unpack * shares.unpacks
    assert one * processes <= limit
    assert shares.check >= 512 * MIB
    assert shares.picture >= 384 * MIB
    assert shares.unpack >= 128 * MIB


def test_without_a_limit_a_program_may_take_what_the_largest_photo_needs() -> None:
    shares = memory_shares(None, 3)
    assert (shares.check, shares.picture, shares.pictures, shares.unpacks) == (
        CHECK_BYTES,
        PICTURE_BYTES,
        2,
        4,
    )


@pytest.mark.anyio
async def test_a_photo_that_needs_more_than_the_check_may_take_is_refused_and_kills_nothing(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset_check, "memory_limit", lambda: int(1.5 * GIB))
    program = (sys.executable, "-m", "workers.datasets.dataset_check_process")
    settings = quick_settings(tmp_path / "data", database_url=database_url, check_command=program)
    async with opened(settings) as stores:
        dataset = await stores.datasets.create("large")
        for shade in range(4):
            photo = tmp_path / f"{shade}.png"
            Image.new("RGB", (9000, 9000), (shade,) * 3).save(photo, compress_level=1)
            await stores.datasets.add_file(dataset.id, photo.name, chunks(photo.read_bytes()))
        await stores.datasets.finalize(dataset.id)
        error = (await stores.datasets.check(dataset.id)).error
    assert error is not None
    assert error.code == "image_too_large"
    assert error.detail == "has 9000 x 9000 px, for which there is not enough memory."


def test_the_checks_program_keeps_to_the_limit_that_it_is_told() -> None:
    program = (
        "from workers.datasets.dataset_check_process import confine; confine();"
        "import resource; print(resource.getrlimit(resource.RLIMIT_AS)[0])"
    )
    said = {**os.environ, CHECK_VARIABLE: str(GIB)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=said, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) == GIB

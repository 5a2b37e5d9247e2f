"""A small storm: what `python -m benchmarks.chaos` does with hundreds of jobs, with a few."""

from __future__ import annotations

import pytest

from benchmarks.chaos.__main__ import storm
from tests.workers.conftest import short_folder

pytestmark = [pytest.mark.server, pytest.mark.anyio]


async def test_every_job_of_a_small_storm_ends_right_and_nothing_is_left():
    with short_folder() as folder:
        claims, happened = await storm(folder, jobs=10, workers=2, every_s=3.0, seed=3)
    assert {claim.name: claim.broken for claim in claims if claim.broken} == {}
    assert len(claims) == 9
    assert sum(happened["faults"].values()) >= 3, "there was no storm"

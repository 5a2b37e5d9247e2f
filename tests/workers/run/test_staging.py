"""What the process of a job finds in its folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from biresnerf.options.refine_options import RefineOptions
from tests.workers.conftest import claimed, ready_dataset, taken_by_somebody
from workers.engine import Stores
from workers.run.staging import stage_job
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


async def test_the_process_gets_the_options_that_were_sent_so_that_it_can_fill_in_the_others_itself(
    stores: Stores, settings: Settings, tmp_path: Path
):
    """How long stage 1 takes, say, depends on where the poses come from, unless it was asked for."""
    dataset_id = await ready_dataset(stores, {"a.txt": b"photo"})
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast", steps=500))
    assert (job.options, job.resolved_options) == ({"preset": "fast", "steps": 500}, None)
    await taken_by_somebody(stores.jobs._database)
    claim = await claimed(stores.jobs._database, job.id)
    assert claim is not None
    await stage_job(stores.jobs._database, stores.files, settings, claim, tmp_path / "job")
    order = json.loads((tmp_path / "job" / "job.json").read_text())
    assert order["options"] == {"preset": "fast", "steps": 500}
    assert (tmp_path / "job" / "input" / "a.txt").read_bytes() == b"photo"


async def test_the_process_is_told_what_the_user_calls_the_set(
    stores: Stores, settings: Settings, tmp_path: Path
):
    dataset_id = await ready_dataset(stores, {"a.txt": b"photo"})
    for name in ({}, {"name": "kitchen"}):
        job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), labels=name)
        await taken_by_somebody(stores.jobs._database)
        claim = await claimed(stores.jobs._database, job.id)
        assert claim is not None
        await stage_job(stores.jobs._database, stores.files, settings, claim, tmp_path / "job")
        order = json.loads((tmp_path / "job" / "job.json").read_text())
        assert order["title"] == name.get("name")

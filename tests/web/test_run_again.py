"""The form that runs a job again with other options."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Locator, expect

from biresnerf.client import Client
from biresnerf.commands.poses.inspect import in_minutes
from tests.service.conftest import PROGRAM, Running
from tests.web.conftest import again
from tests.web.watched import Watched

pytestmark = pytest.mark.jobs_by(PROGRAM)


def times_of(dialog: Locator, presets: list[str]) -> dict[str, str]:
    """The times beside the presets, where there are any."""
    cards = {name: dialog.locator("label.preset").filter(has_text=name.capitalize()) for name in presets}
    found = {name: card.locator(".preset-time").all_inner_texts() for name, card in cards.items()}
    return {name: texts[0] for name, texts in found.items() if texts}


def test_presets_of_another_run_show_their_times_but_where_options_change_them(
    tab: Watched, service: Running, kitchen: Path, api: httpx.Client
) -> None:
    with Client(service.url) as client:
        job = client.submit(kitchen, {"preset": "fast", "steps": 20, "seed": 1})
        client.wait(job.id)
    expected = api.get(f"/datasets/{job.dataset_id}").json()["report"]["expected_s"]
    times = {name: f"about {in_minutes(*between)}" for name, between in expected.items()}
    assert len(times) == 4
    dialog = again(tab.page, f"{service.url}/#/jobs/{job.id}")
    expect(dialog.get_by_text("Times are of runs from the start.")).to_be_visible()
    # This job's own preset was given other steps.
    assert times_of(dialog, [*times]) == {name: words for name, words in times.items() if name != "fast"}
    dialog.get_by_text("For most image sets").click()
    assert times_of(dialog, [*times]) == times
    assert tab.findings_in_each_look() == []
    dialog.get_by_text("More options").click()
    dialog.get_by_label("Steps", exact=True).fill("500")
    expect(dialog.locator(".preset-time")).to_have_count(0)
    assert (tab.outside, tab.complaints) == ([], [])

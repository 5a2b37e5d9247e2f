"""Two jobs whose poses are far apart: the page says so first, and which one the evidence favours."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from biresnerf.client import Client
from tests.service.conftest import PROGRAM, Running
from tests.web.comparison import expect_conclusion, files_of
from tests.web.watched import Watched

pytestmark = pytest.mark.jobs_by(PROGRAM)


def test_results_that_contradict_each_other_are_told_apart_by_the_evidence(
    tab: Watched, service: Running, api: httpx.Client, kitchen: Path
) -> None:
    with Client(service.url) as client:
        wrong, right = (
            client.wait(client.submit(kitchen, {"preset": "fast", "steps": 20, "seed": seed}).id).id
            for seed in (40, 1)
        )
    page = tab.page
    page.goto(f"{service.url}/#/compare/{wrong}/{right}")
    conclusion = page.get_by_role("region", name="Conclusion")
    expect(conclusion).to_contain_text("The results contradict each other")
    expect(conclusion).to_contain_text(
        "The evidence favours the second: it is better by the number of photos confirmed."
    )
    expect_conclusion(page, files_of(api, wrong), files_of(api, right))
    confirmed = page.get_by_role("row").filter(has_text="Photos confirmed").get_by_role("cell")
    assert [text.split() for text in confirmed.all_inner_texts()] == [
        ["0", "of", "3"],
        ["3", "of", "3", "better"],
    ]
    expect(page.get_by_text("one is wrong")).to_have_count(3)
    assert tab.findings() == []
    assert tab.complaints == []

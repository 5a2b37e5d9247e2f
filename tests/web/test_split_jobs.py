"""A job that has split itself: its page lists the parts, and their pages lead back to it."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from biresnerf.client import Client
from tests.service.conftest import PROGRAM, Running
from tests.web.watched import Watched

pytestmark = pytest.mark.jobs_by(PROGRAM)


def test_the_page_of_a_split_job_lists_its_parts(tab: Watched, service: Running, kitchen: Path) -> None:
    page = tab.page
    with Client(service.url) as client:
        asked = {"preset": "fast", "steps": 20, "seed": 100}
        whole = client.submit(kitchen, asked, part_photos=20, labels={"name": "hall"})
        page.goto(f"{service.url}/#/jobs/{whole.id}")
        expect(page.get_by_text("parts are over").first).to_be_visible()
        listed = page.get_by_role("region", name="Parts").get_by_role("listitem")
        expect(listed).to_have_count(3)
        done = client.wait(whole.id)
    assert (done.state, done.parts and done.parts.over) == ("succeeded", 3)
    expect(listed.filter(has_text="done, after")).to_have_count(3)
    assert tab.findings() == []
    listed.nth(1).get_by_role("link", name="hall, part 2 of 3").click()
    expect(page.get_by_role("heading", level=1)).to_contain_text("hall, part 2 of 3")
    page.get_by_text("Options and times").click()
    page.get_by_role("link", name=whole.id).click()
    expect(page.get_by_role("heading", level=1)).to_have_text("hall")
    assert tab.complaints == []

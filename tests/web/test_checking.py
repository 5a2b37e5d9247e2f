"""The page while a set is checked: how many of its photos are read by now."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.conftest import Running
from tests.web.conftest import check_row, drop
from tests.web.watched import Watched

pytestmark = pytest.mark.checks_by(Path(__file__).with_name("pausing_check.py"))


def test_a_check_shows_how_many_photos_of_how_many_are_read(
    tab: Watched, service: Running, kitchen: Path
) -> None:
    page = tab.page
    page.goto(service.url)
    drop(page, kitchen)
    images = check_row(page, "Images")
    expect(images).to_contain_text("3 of 10 photos read")
    bar = images.get_by_role("progressbar", name="Photos read")
    assert bar.evaluate("bar => [bar.value, bar.max]") == [3, 10]
    assert tab.findings_in_each_look() == []
    url = page.url
    page.goto(service.url)
    waiting = page.get_by_role("region", name="Not started yet").locator(".set-card", has_text="kitchen")
    expect(waiting).to_contain_text("being checked (3 of 10 photos read)")
    page.goto(url)
    (service.data_dir / "go").touch()
    expect(images).to_contain_text("10 images of 40 × 40 px, all readable")
    expect(images.get_by_role("progressbar")).to_have_count(0)
    assert (tab.outside, tab.complaints) == ([], [])

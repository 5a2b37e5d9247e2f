"""The operator's view in a real browser: live for who may see it, and not even linked for others."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from biresnerf.client import Client
from tests.service.conftest import PROGRAM, Running, operator
from tests.web.watched import Watched

# With jobs that take as long as they are told, and fail if they are told.
pytestmark = pytest.mark.jobs_by(PROGRAM)


def row(page: Page, table: str, text: str) -> object:
    return page.get_by_role("region", name=table, exact=True).get_by_role("row").filter(has_text=text)


def test_the_operator_sees_slots_queue_sizes_and_failures_change(
    tab: Watched, service: Running, kitchen: Path
) -> None:
    page = tab.page
    page.goto(service.url)
    page.get_by_role("link", name="Operator").click()
    expect(page.get_by_role("heading", name="The service at work")).to_be_visible()
    expect(row(page, "Slots", "cpu0")).to_contain_text("none")
    expect(page.get_by_text("None.")).to_be_visible()
    with Client(service.url) as client:
        failed = client.submit(kitchen, {"preset": "fast", "steps": 20, "threads": 77})
        expect(row(page, "Last failures", failed.id)).to_contain_text(
            "The optimisation diverged: The loss is not finite."
        )
        running = client.submit(kitchen, {"preset": "fast", "steps": 4000, "seed": 20})
        slot = row(page, "Slots", "cpu0")
        expect(slot).to_contain_text(running.id)
        expect(slot).to_contain_text("Stage 1: poses")
        expect(row(page, "Queue", "normal").get_by_role("cell").nth(3)).to_have_text("1")
        expect(row(page, "Sizes", "MB")).to_be_visible()
        tab.screenshot("operator")
        assert tab.findings_in_each_look() == []
        client.cancel(running.id)
        expect(slot).to_contain_text("none")
    assert (tab.complaints, tab.outside) == ([], [])


# Last: from then on the service asks everybody for a key.
def test_a_key_without_the_scope_sees_neither_link_nor_view(tab: Watched, service: Running) -> None:
    with ThreadPoolExecutor(1) as aside:  # Playwright's own loop runs in this thread
        create = (service.data_dir, "keys", "create", "k", "--scope")
        usual, admin = (aside.submit(operator, *create, scope).result()["key"] for scope in ("read", "admin"))
    page = tab.page
    page.goto(service.url)
    page.get_by_label("API key").fill(usual)
    page.get_by_label("API key").press("Enter")
    expect(
        page.get_by_text("No jobs yet").or_(page.get_by_role("heading", name="Jobs", exact=True))
    ).to_be_visible()
    page.wait_for_load_state("networkidle")
    expect(page.get_by_role("link", name="Operator")).to_have_count(0)
    page.goto(f"{service.url}/#/operator")
    expect(page.get_by_role("alert")).to_contain_text("lacks the scope")
    page.get_by_role("button", name="Forget the key").click()
    page.get_by_label("API key").fill(admin)
    page.get_by_label("API key").press("Enter")
    expect(page.get_by_role("link", name="Operator")).to_be_visible()
    expect(page.get_by_role("heading", name="The service at work")).to_be_visible()

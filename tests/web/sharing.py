"""The page of a job, seen by somebody who has nothing but a link to it."""

from __future__ import annotations

import re
from pathlib import Path

from playwright.sync_api import Browser, Page, expect

from tests.web.watched import DESKTOP, watched_page


def expect_a_link_to_show_the_page_until_it_is_revoked(browser: Browser, page: Page, origin: str) -> None:
    """``page`` is a job's, seen with a key."""
    page.get_by_role("button", name="Share", exact=True).click()
    page.get_by_role("button", name="Create a link").click()
    link = page.get_by_label("Link to this page").input_value()
    job = page.url.rpartition("/")[2]
    assert re.fullmatch(re.escape(f"{origin}/#/shared/{job}/") + r"brl_[\w-]+", link)
    links = page.get_by_role("list", name="Links to this page").get_by_role("listitem")
    expect(links).to_have_count(1)
    context = browser.new_context(viewport=DESKTOP, accept_downloads=True)
    guest = watched_page(context, origin)
    seen = guest.page
    seen.goto(link)
    # The set's name is its owner's: strangers see the job's number.
    expect(seen.get_by_role("heading", level=1)).to_contain_text(f"Job {job.removeprefix('job_')[:12]}")
    expect(seen.get_by_text("This page can be seen until")).to_be_visible()
    expect(seen.get_by_role("region", name="Verdict")).to_be_visible()
    with seen.expect_download() as coming:
        seen.get_by_role("button", name="Download For nerfstudio").click()
    assert Path(coming.value.path()).stat().st_size > 0
    seen.wait_for_function("() => document.querySelector('.compare-frame img')?.naturalWidth > 0")
    for name in ("Delete", "Share", "Run again …", "curl, Python For nerfstudio"):
        expect(seen.get_by_role("button", name=name, exact=True)).to_have_count(0)
    assert guest.findings_in_each_look() == []
    assert (guest.complaints, guest.outside) == ([], [])
    links.get_by_role("button", name="Revoke").click()
    expect(links).to_have_count(0)
    seen.reload()
    expect(seen.get_by_role("alert")).to_contain_text("This link opens nothing")
    context.close()

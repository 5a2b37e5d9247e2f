"""What goes another way than the walk: broken connections, files that are too large, jobs that fail."""

from __future__ import annotations

import io
import shutil
import zipfile
from contextlib import closing
from pathlib import Path

import httpx
from playwright.sync_api import Browser, Route, expect

from tests.service.conftest import LIMITS, Running
from tests.web.conftest import DESKTOP, check_row, drop, watched_page


def test_an_archive_goes_on_after_the_connection_broke(
    browser: Browser, service: Running, kitchen: Path
) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted(kitchen.rglob("*")):
            archive.write(path, f"kitchen/{path.relative_to(kitchen)}")
    with closing(browser.new_context(viewport=DESKTOP)) as context:
        page = watched_page(context, service.url).page
        broken: list[str] = []

        def break_once(route: Route) -> None:
            if route.request.method == "PATCH" and not broken:
                broken.append(route.request.url)
                route.abort("connectionreset")
            else:
                route.continue_()

        page.route("**/v1/uploads/*", break_once)
        page.goto(service.url)
        sent = {"name": "again.zip", "mimeType": "application/zip", "buffer": packed.getvalue()}
        page.locator("input[type=file]").nth(1).set_input_files(sent)
        expect(page.get_by_role("button", name="Refine the poses")).to_be_visible()
        assert len(broken) == 1
        expect(check_row(page, "Images")).to_contain_text("10 images")
        page.reload()
        expect(check_row(page, "Images")).to_contain_text("10 images")


def test_files_that_are_too_large_are_named_before_anything_is_sent(
    browser: Browser, service: Running, tmp_path: Path, api: httpx.Client
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "small.png").write_bytes(bytes(100))
    (folder / "huge.png").write_bytes(bytes(LIMITS["max_file_bytes"] + 1))
    before = api.get("/datasets").json()["items"]
    with closing(browser.new_context(viewport=DESKTOP)) as context:
        page = watched_page(context, service.url).page
        page.goto(service.url)
        drop(page, folder)
        refusal = page.get_by_role("alert")
        expect(refusal).to_contain_text("huge.png")
        assert "small.png" not in refusal.inner_text()
    assert [item["id"] for item in api.get("/datasets").json()["items"]] == [item["id"] for item in before]


def test_a_job_that_fails_says_what_and_what_to_do(
    browser: Browser, service: Running, kitchen: Path, tmp_path: Path
) -> None:
    with closing(browser.new_context(viewport=DESKTOP)) as context:
        watched = watched_page(context, service.url)
        page = watched.page
        page.goto(service.url)
        folder = tmp_path / "photos"
        folder.mkdir()
        for photo in sorted(kitchen.rglob("*.png"))[:4]:
            shutil.copy(photo, folder)
        drop(page, folder)
        expect(check_row(page, "Poses")).to_contain_text("0 of 4 given")
        page.get_by_label("start", exact=True).select_option("given")
        page.get_by_role("button", name="Refine the poses").click()
        expect(page.get_by_role("alert")).to_contain_text("What to do")
        watched.screenshot("job-failed")
        assert watched.serious_findings() == []
        expect(page.get_by_role("button", name="Run again …")).to_be_visible()

"""What goes another way than the walk: broken connections, jobs that fail, a service that wants a key.

The last module of this folder: after it the service asks everybody for a key.
"""

from __future__ import annotations

import io
import shutil
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page, Route, expect

from tests.service.conftest import LIMITS, Running, operator
from tests.web.conftest import DESKTOP, check_row, watched_page


def drop(page: Page, *paths: Path) -> None:
    """Drops files and folders onto the page, as a file manager does."""
    place = page.locator(".drop").bounding_box()
    assert place is not None
    wire = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        where = {"x": place["x"] + 20, "y": place["y"] + 20}
        wire.send("Input.dispatchDragEvent", {"type": kind, **where, "data": data})


def test_an_archive_goes_on_after_the_connection_broke(
    browser: Browser, service: Running, kitchen: Path, done: dict[str, Any]
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
    browser: Browser, service: Running, kitchen: Path, tmp_path: Path, done: dict[str, Any]
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


def test_a_job_is_run_again_ended_and_deleted(
    browser: Browser, service: Running, job_url: str, done: dict[str, Any], api: httpx.Client
) -> None:
    with closing(browser.new_context(viewport=DESKTOP)) as context:
        watched = watched_page(context, service.url)
        page = watched.page
        page.goto(job_url)
        page.get_by_role("button", name="Run again …").click()
        dialog = page.get_by_role("dialog", name="Run again with other options")
        steps = dialog.get_by_label("steps", exact=True)
        assert steps.get_attribute("placeholder") == "500"
        steps.fill("20000")
        assert watched.serious_findings() == []
        dialog.get_by_role("button", name="Run from the start").click()
        page.wait_for_url(lambda url: "#/jobs/" in url and url != job_url)
        job = page.url.rpartition("/")[2]
        options = api.get(f"/jobs/{job}").json()["options"]
        assert options == {**done["options"], "steps": 20000}
        page.get_by_role("button", name="Cancel", exact=True).click()
        page.get_by_role("button", name="End it, keep nothing").click()
        expect(page.get_by_role("heading", level=1)).to_contain_text("cancelled")
        page.get_by_role("button", name="Delete", exact=True).click()
        page.get_by_role("button", name="Delete it").click()
        page.wait_for_url("**/#/")
        assert api.get(f"/jobs/{job}").status_code == 404


# Last: from then on the service asks everybody for a key.
def test_a_service_with_keys_is_used_with_one(
    browser: Browser, service: Running, job_url: str, done: dict[str, Any]
) -> None:
    with ThreadPoolExecutor(1) as aside:  # Playwright's own loop runs in this thread
        made = aside.submit(operator, service.data_dir, "keys", "create", "page", "--tenant", "local")
        key = made.result()["key"]
    with closing(browser.new_context(viewport=DESKTOP)) as context:
        watched = watched_page(context, service.url)
        page = watched.page
        page.goto(job_url)
        field = page.get_by_label("API key")
        field.fill("brn_wrong")
        field.press("Enter")
        expect(page.get_by_role("alert")).to_contain_text("unknown, expired or revoked")
        watched.screenshot("key")
        field.fill(key)
        field.press("Enter")
        page.wait_for_function("() => document.querySelector('.compare-frame img')?.naturalWidth > 0")
        assert page.locator(".compare-frame img").first.get_attribute("src").startswith("blob:")
        with page.expect_download() as coming:
            page.get_by_role("button", name="Download For nerfstudio").click()
        assert coming.value.suggested_filename == "transforms.json"
        page.reload()
        expect(page.get_by_role("heading", name="Downloads")).to_be_visible()
        assert watched.outside == []

"""`make screenshots`: pictures of the web page for the docs, in Chromium, from a real service with a synthetic scene.

Takes some minutes. Writes the files of `SCREENSHOTS`, and keeps the job's result as the finished example of the page.
Fails if a picture shows a prediction that its own run missed by more than the factor `MOST_MISSED`.
"""

from __future__ import annotations

import io
import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, Playwright, sync_playwright

from biresnerf.client import Client
from biresnerf.commands.poses.make_scene import make_scene
from docs.generate.pages import ROOT
from docs.generate.pictures.example import keep_example
from service.commands.temporary_service import temporary_service
from service.web_page import EXAMPLE

FOLDER = ROOT / "docs/pictures"
SCREENSHOTS = {
    name: FOLDER / f"page_{name}.webp" for name in ("check", "running", "list", "result", "compare")
}
NAME, KIND, VIEWS, SIZE, NOISE, SEED = "still-life", "still-life", 32, 160, 0.12, 3
OTHER = {"preset": "fast", "steps": 500}  # of the job that the first is compared with
PERCENT = "Number(document.querySelector('[role=progressbar]')?.getAttribute('aria-valuenow'))"
RUNNING_PERCENT = 50  # of the run, where its picture is taken
WIDTH, HEIGHT, QUALITY = 1200, 900, 82
SHOWN_HEIGHTS = {"list": 560}  # px; below is nothing
MOST_MISSED = 3.0  # times
PATIENCE_MS, SETTLING_MS = 1_800_000, 5_000
# WebGL without a GPU.
ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader")


def main() -> None:
    """Make a scene, and use the page from the upload to the comparison of two jobs."""
    with (
        tempfile.TemporaryDirectory() as temporary,
        temporary_service() as url,
        sync_playwright() as playwright,
    ):
        scene = Path(temporary, NAME)
        browser = chromium_of(playwright)
        make_scene(scene, KIND, views=VIEWS, size=SIZE, noise=NOISE, seed=SEED)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.set_default_timeout(PATIENCE_MS)
        page.goto(url)
        page.locator("input[type=file]").first.set_input_files(scene)
        _show_check(page)
        first, dataset = _job_of(page, url)
        _show_running(page)
        with Client(url) as client:
            left, at = client.job(first).progress.eta_s, datetime.now(UTC)
            _show_result(page)
            _check_predictions(client, first, left, at)
            client.download_all(first, Path(temporary, "result"))
            keep_example(Path(temporary, "result"), EXAMPLE)
            second = client.create_job(dataset, OTHER, labels={"name": f"{NAME}, {OTHER['steps']} steps"})
            _show_list(page, url)
            client.wait(second.id)
        _show_comparison(page, f"{url}/#/compare/{first}/{second.id}")
        browser.close()


def chromium_of(playwright: Playwright) -> Browser:
    """Launch Debian's Chromium."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        raise SystemExit("There is no Chromium; on Debian: apt install chromium")
    return playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)


def _show_check(page: Page) -> None:
    page.get_by_role("button", name="Refine the poses").wait_for()
    page.get_by_text("A first result within minutes").click()
    page.get_by_role("application").wait_for()
    _wait_for_drawing(page)
    _take(page, "check")


def _job_of(page: Page, url: str) -> tuple[str, str]:
    """Starts the job; returns its id and its set's."""
    with page.expect_response(f"{url}/v1/jobs") as sent:
        page.get_by_role("button", name="Refine the poses").click()
    job = sent.value.json()
    return job["id"], job["dataset_id"]


def _show_running(page: Page) -> None:
    page.get_by_role("img", name="render of one view").wait_for()
    page.wait_for_function(f"() => {PERCENT} > {RUNNING_PERCENT}")
    _wait_for_drawing(page)
    _take(page, "running")


def _check_predictions(client: Client, job_id: str, left: float | None, at: datetime) -> None:
    """Compare the seconds that the check predicted, and those ``left`` during the job, with the actual ones."""
    job = client.job(job_id)
    report = client.dataset(job.dataset_id).report
    if report is None or job.started_at is None or job.finished_at is None or left is None:
        raise SystemExit("A picture shows a job without a prediction.")
    whole = report.expected_s[report.preset]
    for picture, (low, high), took in (
        ("check", whole, (job.finished_at - job.started_at).total_seconds()),
        ("running", (left, left), (job.finished_at - at).total_seconds()),
    ):
        print(f"page_{picture}: predicted {low:.0f} to {high:.0f} s, took {took:.0f} s")
        if not low / MOST_MISSED <= took <= high * MOST_MISSED:
            raise SystemExit(
                f"page_{picture} shows a prediction that its run missed by more than {MOST_MISSED:g} times."
            )


def _show_result(page: Page) -> None:
    page.get_by_role("heading", name="Downloads").wait_for()
    page.get_by_role("slider", name="Swipe between photo and render").wait_for()
    page.wait_for_function("() => document.querySelector('.compare-frame img')?.naturalWidth > 0")
    _wait_for_drawing(page)
    _take(page, "result")


def _show_list(page: Page, url: str) -> None:
    page.goto(url)
    page.locator(".job-card").nth(1).wait_for()
    page.wait_for_function(
        "() => [...document.querySelectorAll('.job-card img')].every(e => e.naturalWidth > 0)"
    )
    page.wait_for_function(f"() => {PERCENT} > 0")
    _take(page, "list")


def _show_comparison(page: Page, address: str) -> None:
    page.goto(address)
    page.get_by_role("img", name="PSNR of the training views").wait_for()
    _wait_for_drawing(page)
    _take(page, "compare")


def _wait_for_drawing(page: Page) -> None:
    """Wait for what is drawn after the markup: the 3-D view, its photos and the curves."""
    page.wait_for_timeout(SETTLING_MS)


def _take(page: Page, name: str) -> None:
    save_screenshot(page, SCREENSHOTS[name], SHOWN_HEIGHTS.get(name, HEIGHT))


def save_screenshot(page: Page, path: Path, height: int = HEIGHT) -> None:
    """Writes the upper ``height`` px of the page."""
    page.mouse.move(0, 0)
    page.evaluate("scrollTo(0, 0)")
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        picture.convert("RGB").crop((0, 0, WIDTH, height)).save(path, quality=QUALITY, method=6)
    print(f"written: {path}")


if __name__ == "__main__":
    main()

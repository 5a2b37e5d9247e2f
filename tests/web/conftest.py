"""A real browser on a real service with one real, small job, shared by the tests of a module."""

from __future__ import annotations

import re
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from playwright.sync_api import (
    Browser,
    Locator,
    Page,
    expect,
    sync_playwright,
)

import hatch_build
from biresnerf.commands.poses.make_scene import make_scene_command
from tests.service.conftest import Running, running_service, short_folder
from tests.web.watched import DESKTOP, PATIENCE_MS, PHONE, Watched, watched_page

ROOT = Path(__file__).resolve().parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
# WebGL without a GPU, and the page painted without either: a sixth of the work.
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
expect.set_options(timeout=PATIENCE_MS)
# The browser's own notifications, noted; and a user who looks at another window.
LOOKS_ELSEWHERE = """
    window.told = [];
    Document.prototype.hasFocus = () => false;
    const Own = window.Notification;
    window.Notification = class extends Own {
        constructor(title, more) { super(title, more); window.told.push(title); }
    };
"""


# Of a module, not of the session: its event loop runs in the main thread, where other tests want their own.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip(
            "There is no Chromium (Debian: apt install chromium): the page is not tested in a browser."
        )
    if not hatch_build.is_built(ROOT):
        pytest.skip("The page is not built, or of other sources; make web builds it.")
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def service(browser: Browser, request: pytest.FixtureRequest) -> Iterator[Running]:
    """`biresnerf up`, with real jobs and checks or the module's own programs. Without a browser it is not started."""
    commands = {"job_command": "jobs_by", "check_command": "checks_by"}
    own = {name: request.node.get_closest_marker(marker) for name, marker in commands.items()}
    settings = {name: (sys.executable, str(mark.args[0])) for name, mark in own.items() if mark}
    with short_folder() as folder, running_service(folder, **settings) as running:
        yield running


@pytest.fixture(scope="session")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of images with poses that are wrong by a known amount."""
    folder = tmp_path_factory.mktemp("sets") / "kitchen"
    said = CliRunner().invoke(
        make_scene_command, [str(folder), "--views", "10", "--size", "40", "--noise", "0.1", "--seed", "1"]
    )
    assert said.exit_code == 0, said.output
    return folder


@pytest.fixture(scope="module")
def desktop(browser: Browser, service: Running) -> Iterator[Watched]:
    """One tab for the whole walk, as a user has it."""
    context = browser.new_context(viewport=DESKTOP, accept_downloads=True)
    yield watched_page(context, service.url)
    context.close()


@pytest.fixture(scope="module")
def phone(browser: Browser, service: Running) -> Iterator[Watched]:
    context = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True, color_scheme="dark")
    yield watched_page(context, service.url)
    context.close()


def again(page: Page, job_url: str) -> Locator:
    """The dialog that asks for other options."""
    page.goto(job_url)
    page.get_by_role("button", name="Run again …").click()
    return page.get_by_role("dialog", name="Run again with other options")


def another_job(page: Page, job_url: str) -> str:
    """The id of the job that the page went to."""
    page.wait_for_url(lambda url: "#/jobs/" in url and url != job_url)
    return page.url.rpartition("/")[2]


@pytest.fixture
def tab(browser: Browser, service: Running) -> Iterator[Watched]:
    """Another tab, for one test."""
    context = browser.new_context(viewport=DESKTOP, accept_downloads=True)
    yield watched_page(context, service.url)
    context.close()


@pytest.fixture(scope="module")
def digests(api: httpx.Client, done: dict[str, Any]) -> dict[str, str]:
    """SHA-256 of each artifact of the job, by name."""
    return {item["name"]: item["sha256"] for item in api.get(f"/jobs/{done['id']}/artifacts").json()["items"]}


@pytest.fixture(scope="module")
def api(service: Running) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{service.url}/v1", timeout=60.0) as client:
        yield client


def asked_after_reload(page: Page, ending: str) -> int:
    """How often the page asks for addresses with this end, in its first second and until it is idle."""
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.reload(wait_until="networkidle")
    page.wait_for_timeout(1000)
    return sum(url.endswith(ending) for url in asked)


def curve_steps(page: Page) -> list[int]:
    """The first and the last step that the curves show."""
    chart = page.get_by_role("img", name="PSNR of the training views")
    expect(chart).to_be_visible()
    return [int(step) for step in re.findall(r"at step (\d+)", chart.get_attribute("aria-label") or "")]


def drop(page: Page, *paths: Path) -> None:
    """Drops files and folders onto the page, as a file manager does."""
    place = page.locator(".drop").bounding_box()
    assert place is not None
    wire = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        where = {"x": place["x"] + 20, "y": place["y"] + 20}
        wire.send("Input.dispatchDragEvent", {"type": kind, **where, "data": data})


def zip_of(folder: Path, path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, file.relative_to(folder))
    return path


def check_row(page: Page, name: str) -> Locator:
    """A line of the check's table."""
    return page.locator(".checks tr", has=page.get_by_role("rowheader", name=name, exact=True))


@pytest.fixture(scope="module")
def job_url(desktop: Watched, service: Running, kitchen: Path) -> str:
    """The address of a job that was sent through the page; it runs."""
    page = desktop.page
    page.goto(service.url)
    expect(page.get_by_text("No jobs yet")).to_be_visible()
    desktop.screenshot("start")
    page.locator("input[type=file]").first.set_input_files(kitchen)
    submit = page.get_by_role("button", name="Refine the poses")
    expect(submit).to_be_visible()
    expect(check_row(page, "Poses")).to_contain_text("10 of 10 given")
    assert desktop.findings() == []
    page.get_by_text("A first result within minutes").click()
    page.get_by_label("Starting poses", exact=True).select_option("given")
    page.get_by_text("More options").click()
    page.get_by_label("Steps", exact=True).fill("500")
    for name, value in (
        ("Seconds between checkpoints", 2),
        ("Shortest stage 1", 100),
        ("Longest stage 1", 200),
        ("Steps between checks", 10),
        ("Samples per step", 4096),
        ("Steps of the verdict", 20),
        ("Frames of the orbit video", 4),
    ):
        page.get_by_label(name, exact=True).fill(str(value))
    desktop.screenshot("new-job")
    submit.click()
    page.wait_for_url("**/#/jobs/*")
    return page.url


@pytest.fixture(scope="module")
def done(desktop: Watched, job_url: str, api: httpx.Client) -> dict[str, Any]:
    """The same job, over; the tab shows it."""
    page = desktop.page
    page.goto(job_url)
    expect(page.get_by_role("heading", name="Downloads")).to_be_visible()
    job: dict[str, Any] = api.get(f"/jobs/{job_url.rpartition('/')[2]}").json()
    assert job["state"] == "succeeded", job
    return job

"""Sets that a user sends for the first time: the sample, and sets that are refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from biresnerf.viewer.report_html import read_report
from service.web_page import EXAMPLE
from tests.data.given_poses.views import around, written
from tests.service.conftest import LIMITS, Running
from tests.web.conftest import check_row, drop, zip_of
from tests.web.watched import Watched


@pytest.fixture
def page(tab: Watched) -> Page:
    return tab.page


def test_an_archive_that_cannot_be_taken_says_why_and_another_takes_its_place(
    page: Page, service: Running, kitchen: Path, tmp_path: Path
) -> None:
    broken = zip_of(kitchen, tmp_path / "broken.zip")
    broken.write_bytes(broken.read_bytes()[:-100])
    page.goto(service.url)
    page.locator("input[type=file]").nth(1).set_input_files(broken)
    expect(page.get_by_role("alert")).to_contain_text("The archive was rejected")
    expect(page.get_by_role("alert")).to_contain_text("archive_rejected")
    page.locator("input[type=file]").nth(1).set_input_files(zip_of(kitchen, tmp_path / "whole.zip"))
    expect(page.get_by_role("button", name="Refine the poses")).to_be_visible()


def test_a_sample_set_is_one_click_away(page: Page, service: Running) -> None:
    page.goto(service.url)
    page.get_by_role("button", name="Try a sample set").click()
    expect(check_row(page, "Images")).to_contain_text("32 images")
    times = page.locator(".preset-time")
    expect(times).to_have_count(4)
    expect(times.first).to_have_text(re.compile(r"about \d+( s)?( to \d+)? (s|min|h)"))
    expect(page.get_by_role("button", name="Refine the poses")).to_be_visible()
    # It waits in the list, with its first photo, until its job is started.
    page.goto(service.url)
    waiting = page.get_by_role("region", name="Not started yet").locator(".set-card", has_text="sample")
    expect(waiting).to_contain_text("32 photos · ready to start")
    page.wait_for_function("() => document.querySelector('.set-card img')?.naturalWidth > 0")
    waiting.get_by_role("button", name="Delete sample").click()
    expect(waiting).to_have_count(0)


def test_a_finished_example_is_one_click_away_and_needs_no_job(
    tab: Watched, service: Running, api: httpx.Client
) -> None:
    page = tab.page
    before = api.get("/jobs").json()["items"]
    page.goto(service.url)
    page.get_by_role("link", name="See a finished example", exact=True).click()
    expect(page.get_by_role("region", name="Verdict")).to_contain_text("The refined poses are better")
    report = read_report(EXAMPLE)
    expect(page.get_by_text(f"{len(report.images)} photos of a made scene")).to_be_visible()
    expect(page.get_by_role("region", name="Table of images").get_by_role("row")).to_have_count(
        len(report.images) + 1
    )
    with page.expect_download() as coming:
        page.get_by_role("link", name="transforms.json").click()
    frames = json.loads(Path(coming.value.path()).read_text("utf-8"))["frames"]
    assert len(frames) == len(report.images)
    expect(page.get_by_role("application")).to_be_visible()
    page.wait_for_function(
        "() => [...document.querySelectorAll('.compare-frame img')].filter(e => e.naturalWidth > 0).length >= 2"
    )
    page.get_by_role("slider", name="Swipe between photo and render").press("Home")
    expect(page.locator(".curves canvas").first).to_be_visible()
    film = page.get_by_label("A flight around the scene")
    film.evaluate("film => film.play()")
    page.wait_for_function("film => film.currentTime > 0", arg=film.element_handle())
    film.evaluate("film => film.pause()")
    tab.screenshot("example")
    assert tab.findings() == []
    assert (tab.outside, tab.complaints) == ([], [])
    assert api.get("/jobs").json()["items"] == before


def test_who_has_no_job_yet_sees_what_comes_of_one(tab: Watched, service: Running) -> None:
    page = tab.page
    page.route("**/v1/jobs?*", lambda route: route.fulfill(json={"items": [], "next_cursor": None}))
    page.goto(service.url)
    shown = page.get_by_role("region", name="Example result")
    for words in ("given poses", "refined poses", "photo"):
        expect(shown.get_by_text(words, exact=True)).to_be_visible()
    page.wait_for_function(
        "() => [...document.querySelectorAll('.outcome img')].filter(e => e.naturalWidth > 0).length === 3"
    )
    tab.screenshot("no-jobs-yet")
    assert tab.findings_in_each_look() == []
    shown.get_by_role("link").click()
    expect(page.get_by_role("heading", name="A finished example")).to_be_visible()
    assert (tab.outside, tab.complaints) == ([], [])


def test_a_checked_set_shows_its_photos_and_cameras_and_leaves_photos_out(
    tab: Watched, service: Running, kitchen: Path, api: httpx.Client
) -> None:
    page = tab.page
    page.goto(service.url)
    drop(page, kitchen)
    photos = page.get_by_role("button", name=re.compile("^Leave out "))
    expect(photos).to_have_count(10)
    expect(page.get_by_role("application")).to_have_attribute(
        "aria-label", re.compile("^Picture of 10 cameras")
    )
    plan = page.get_by_role("region", name="What will happen")
    expect(plan).to_contain_text("Your poses are the start.")
    expect(plan).to_contain_text(re.compile(r"about \d+( s)?( to \d+)? (s|min|h)"))
    stage, shown = page.get_by_role("application"), page.get_by_role("checkbox", name="Photos", exact=True)
    shown.uncheck()
    bare = stage.screenshot()
    shown.check()
    while stage.screenshot() == bare:  # until the picture of all photos has arrived
        page.wait_for_timeout(100)
    photos.nth(3).click()
    expect(plan).to_contain_text("1 photo of 10 is left out.")
    expect(photos.nth(3)).to_have_attribute("aria-pressed", "true")
    tab.screenshot("checked-set")
    assert tab.findings_in_each_look() == []
    expect(page.locator(".field:visible")).to_have_count(6)
    page.get_by_text("More options").click()
    distance = "./train/r_1, ./train/r_2, 0.5"
    page.get_by_label("Scale", exact=True).fill(distance)
    with page.expect_response(lambda sent: sent.url.endswith("/v1/jobs")) as sent:
        page.get_by_role("button", name="Refine the poses").click()
    job = sent.value.json()
    chosen = {"leave_out": ["./train/r_3"], "known_distance": distance}
    assert job["options"] == {"preset": "fast", **chosen}
    # While nothing is computed yet, the job shows the photos and the given cameras.
    expect(page.get_by_role("list", name="Photos of the set").get_by_role("listitem")).to_have_count(10)
    expect(page.get_by_text("The given cameras.")).to_be_visible()
    expect(page.get_by_role("application")).to_have_attribute(
        "aria-label", re.compile("^Picture of 10 cameras")
    )
    assert tab.findings() == []
    api.post(f"/jobs/{job['id']}/cancel")
    assert tab.complaints == []


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_presets_their_times_and_the_button_are_seen_without_scrolling(
    tab: Watched, service: Running, kitchen: Path, width: int, height: int
) -> None:
    page = tab.page
    page.set_viewport_size({"width": width, "height": height})
    page.goto(service.url)
    drop(page, kitchen)
    expect(page.locator(".preset-time")).to_have_count(4)
    button = page.get_by_role("button", name="Refine the poses")
    for shown in (
        *page.get_by_role("group", name="Preset").get_by_role("radio").all(),
        *page.locator(".preset-time").all(),
        button,
    ):
        box = shown.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= height
    tab.screenshot(f"check-{width}")


def test_poses_that_seem_to_mean_something_else_are_converted_with_a_click(
    tab: Watched, service: Running, tmp_path: Path, api: httpx.Client
) -> None:
    page = tab.page
    written(tmp_path / "cv", around() @ np.diag([1.0, -1, -1, 1]), around())
    page.goto(service.url)
    drop(page, tmp_path / "cv")
    question = page.get_by_role("region", name="Convert the poses?")
    expect(question).to_contain_text("seem to have OpenCV's axes")
    expect(question).to_contain_text("They are used unchanged.")
    box = question.get_by_role("button", name="Convert").bounding_box()
    assert box is not None
    assert box["y"] + box["height"] <= 800
    stage = page.get_by_role("application")
    page.get_by_role("checkbox", name="Photos", exact=True).uncheck()
    given = stage.screenshot()
    question.get_by_role("button", name="Convert").click()
    expect(question.get_by_role("button")).to_have_attribute("aria-pressed", "true")
    while stage.screenshot() == given:  # until the cameras stand otherwise
        page.wait_for_timeout(100)
    tab.screenshot("pose-question")
    assert tab.findings_in_each_look() == []
    with page.expect_response(lambda sent: sent.url.endswith("/v1/jobs")) as sent:
        page.get_by_role("button", name="Refine the poses").click()
    job = sent.value.json()
    assert job["options"] == {"preset": "fast", "given_poses": ["opencv_axes"]}
    api.post(f"/jobs/{job['id']}/cancel")
    assert tab.complaints == []


def a_pdf(folder: Path) -> None:
    (folder / "slides.pdf").write_bytes(b"%PDF-1.7")


def one_photo(folder: Path) -> None:
    Image.effect_noise((40, 40), 50).save(folder / "only.png")


def a_broken_transforms_file(folder: Path) -> None:
    for number in range(4):
        Image.effect_noise((40, 40), 50).save(folder / f"{number}.png")
    (folder / "transforms.json").write_text('{"frames": [')


def photos_of_a_phone_that_are_not_read(folder: Path) -> None:
    (folder / "IMG_0001.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))


@pytest.mark.parametrize(
    "fill", [a_pdf, one_photo, a_broken_transforms_file, photos_of_a_phone_that_are_not_read]
)
def test_a_refused_set_says_why_and_takes_another_also_after_a_reload(
    tab: Watched, service: Running, tmp_path: Path, fill: Callable[[Path], None]
) -> None:
    page, folder = tab.page, tmp_path / "set"
    folder.mkdir()
    fill(folder)
    page.goto(service.url)
    drop(page, folder)
    for _ in range(2):
        expect(page.get_by_role("alert")).to_contain_text("The image set was rejected")
        expect(page.get_by_role("alert")).to_contain_text("What to do")
        expect(page.get_by_text("rejected", exact=True)).to_be_visible()
        expect(page.get_by_text("Choose a folder")).to_be_visible()
        page.reload()
    tab.screenshot(f"refused-{fill.__name__.replace('_', '-')}")
    assert tab.findings() == []
    assert tab.complaints == []


def test_a_fault_of_one_view_leaves_the_rest_of_the_page(page: Page, service: Running) -> None:
    page.route("**/v1/jobs?*", lambda route: route.fulfill(json={"items": [{}], "next_cursor": None}))
    page.goto(service.url)
    expect(page.get_by_role("alert")).to_contain_text("This view cannot be shown")
    expect(page.get_by_role("link", name="BiResNeRF")).to_be_visible()


def test_files_that_are_too_large_are_named_before_anything_is_sent(
    page: Page, service: Running, tmp_path: Path, api: httpx.Client
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "small.png").write_bytes(bytes(100))
    (folder / "huge.png").write_bytes(bytes(LIMITS["max_file_bytes"] + 1))
    before = api.get("/datasets").json()["items"]
    page.goto(service.url)
    drop(page, folder)
    refusal = page.get_by_role("alert")
    expect(refusal).to_contain_text("huge.png")
    assert "small.png" not in refusal.inner_text()
    assert [item["id"] for item in api.get("/datasets").json()["items"]] == [item["id"] for item in before]

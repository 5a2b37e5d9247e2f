"""Cases beside the usual walk: broken connections, sets that are refused, jobs that fail, many jobs."""

from __future__ import annotations

import re
import shutil
import time
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

from biresnerf.client import Client
from tests.data.photos.video.filmed import film
from tests.service.conftest import Running
from tests.web.conftest import check_row, drop, zip_of
from tests.web.watched import DESKTOP, PHONE, Watched, watched_page

PROGRAM = Path(__file__).with_name("matching_program.py")
WAITING = 55
# The picture with all photos is there, and more than one colour is seen of it.
SHEET_DRAWN = """async () => {
    const thumb = document.querySelector(".photo .thumb");
    const url = thumb && /url\\("(.*)"\\)/.exec(getComputedStyle(thumb).backgroundImage)?.[1];
    if (!url) return false;
    const bitmap = await createImageBitmap(await (await fetch(url)).blob());
    const pen = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    pen.drawImage(bitmap, 0, 0);
    const {data} = pen.getImageData(0, 0, bitmap.width, bitmap.height);
    return new Set(data.filter((_, i) => i % 4 === 0)).size > 50;
}"""


# With jobs that go on until they are ended, and real ones where the given poses are to be taken.
pytestmark = pytest.mark.jobs_by(PROGRAM)


@pytest.fixture
def page(tab: Watched) -> Page:
    return tab.page


@pytest.fixture(scope="module")
def busy(service: Running, kitchen: Path, api: httpx.Client) -> str:
    """A job sent by a program, that runs, and many that wait for it."""
    with Client(service.url) as client:
        first = client.submit(kitchen, {"preset": "fast"})
    for number in range(WAITING):
        body = {"dataset_id": first.dataset_id, "labels": {"name": f"job {number:02}"}}
        assert api.post("/jobs", json=body).status_code == 202
    return first.id


def names(page: Page) -> list[str]:
    return page.locator(".job-card strong").all_inner_texts()


def test_the_page_asks_again_only_when_an_overloaded_service_wants_it(page: Page, service: Running) -> None:
    asked: list[float] = []

    def overloaded_once(route: Route) -> None:
        asked.append(time.monotonic())
        if len(asked) == 1:
            problem = {"code": "database_unavailable", "title": "Not now", "detail": "The database is busy."}
            route.fulfill(status=503, headers={"Retry-After": "5"}, json=problem)
        else:
            route.continue_()

    page.route("**/v1/jobs?*", overloaded_once)
    page.goto(service.url)
    expect(page.get_by_text("The database is busy.")).to_be_visible()
    expect(page.get_by_text("The database is busy.")).to_be_hidden()
    assert asked[1] - asked[0] >= 5


def test_an_archive_goes_on_after_the_connection_broke(
    page: Page, service: Running, kitchen: Path, tmp_path: Path
) -> None:
    broken: list[str] = []

    def break_once(route: Route) -> None:
        if route.request.method == "PATCH" and not broken:
            broken.append(route.request.url)
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/v1/uploads/*", break_once)
    page.goto(service.url)
    page.locator("input[type=file]").nth(1).set_input_files(zip_of(kitchen, tmp_path / "again.zip"))
    expect(page.get_by_role("button", name="Refine the poses")).to_be_visible()
    assert len(broken) == 1
    expect(check_row(page, "Images")).to_contain_text("10 images")
    page.reload()
    expect(check_row(page, "Images")).to_contain_text("10 images")


def test_a_dropped_folder_goes_on_after_a_reload_with_what_is_missing(
    page: Page, service: Running, tmp_path: Path
) -> None:
    folder, files = tmp_path / "new", 8
    folder.mkdir()
    for number in range(files):  # noise: the service has none of these from elsewhere
        Image.effect_noise((40, 40), 50).save(folder / f"{number}.png")
    sent: list[str] = []

    def some(route: Route) -> None:
        sent.append(route.request.url)
        if len(sent) <= 4:
            route.continue_()  # the others never get an answer

    page.route("**/v1/datasets/*/files/**", some)
    page.goto(service.url)
    drop(page, folder)
    expect(check_row(page, "Files")).to_contain_text(f"; {files - 4} to come")
    page.reload()  # what waits for an answer is given up with the page
    page.unroute_all(behavior="ignoreErrors")
    expect(page.get_by_role("heading", name=f"{files - 4} files still to come")).to_be_visible()
    again: list[str] = []
    page.on("request", lambda request: again.append(request.url) if request.method == "PUT" else None)
    drop(page, folder)
    expect(page.get_by_role("button", name="Refine the poses")).to_be_visible()
    assert len(again) == files - 4
    assert not {*again} & {*sent[:4]}


def test_an_archive_goes_on_after_a_reload_from_its_last_byte(
    page: Page, service: Running, kitchen: Path, tmp_path: Path
) -> None:
    archive = zip_of(kitchen, tmp_path / "set.zip")
    half = archive.stat().st_size // 2
    offsets: list[int] = []

    def first_half(route: Route) -> None:
        if route.request.method != "PATCH":
            route.continue_()
            return
        offsets.append(int(route.request.headers["upload-offset"]))
        if offsets[-1] == 0:  # more than once where the connection is given up under load
            route.continue_(post_data=archive.read_bytes()[:half])
        else:
            route.abort("connectionreset")

    page.route("**/v1/uploads/*", first_half)
    page.goto(service.url)
    page.locator("input[type=file]").nth(1).set_input_files(archive)
    page.wait_for_url("**/#/datasets/*")
    while not offsets or offsets[-1] == 0:
        page.wait_for_timeout(50)
    page.reload()
    expect(page.get_by_role("heading", name="Nothing has arrived completely")).to_be_visible()
    page.unroute_all()
    with page.expect_request(lambda request: request.method == "PATCH") as going_on:
        page.locator("input[type=file]").nth(1).set_input_files(archive)
    assert int(going_on.value.headers["upload-offset"]) == half
    expect(check_row(page, "Images")).to_contain_text("10 images")


def test_a_job_that_fails_says_what_and_what_to_do(
    tab: Watched, service: Running, kitchen: Path, tmp_path: Path
) -> None:
    page = tab.page
    page.goto(service.url)
    folder = tmp_path / "photos"
    folder.mkdir()
    for photo in sorted(kitchen.rglob("*.png"))[:4]:
        shutil.copy(photo, folder)
    drop(page, folder)
    expect(check_row(page, "Poses")).to_contain_text("0 of 4 given")
    start = page.get_by_label("Starting poses", exact=True)
    expect(start).to_have_accessible_description(re.compile("Your poses, with COLMAP filling the gaps"))
    start.select_option("given")
    expect(start).to_have_accessible_description("Where to start from. Your poses only.")
    page.get_by_role("button", name="Refine the poses").click()
    expect(page.get_by_role("alert")).to_contain_text("What to do")
    tab.screenshot("job-failed")
    assert tab.findings() == []
    expect(page.get_by_role("button", name="Run again …")).to_be_visible()


def test_options_that_contradict_each_other_are_named_as_in_the_form(
    tab: Watched, service: Running, kitchen: Path
) -> None:
    page = tab.page
    page.goto(service.url)
    drop(page, kitchen)
    page.get_by_text("More options").click()
    page.get_by_label("Shortest stage 1", exact=True).fill("300")
    page.get_by_label("Longest stage 1", exact=True).fill("200")
    page.get_by_role("button", name="Refine the poses").click()
    refusal = page.get_by_role("alert").first
    expect(refusal).to_contain_text("“Shortest stage 1” (300) must not exceed “Longest stage 1” (200)")
    assert tab.findings() == []


def test_the_frames_of_a_video_are_shown_and_the_page_says_that_they_cannot_be_masked(
    tab: Watched, service: Running, tmp_path: Path
) -> None:
    page, video = tab.page, tmp_path / "walk.mov"
    film(video, range(0, 200, 5), [False] * 40)
    page.goto(service.url)
    drop(page, video)
    frames = page.get_by_role("button", name=re.compile(r"^Leave out .*walk"))
    expect(frames).to_have_count(40)
    expect(page.get_by_text("masks need photos")).to_be_visible()
    expect(page.get_by_role("radio", name="masks parts of it")).to_have_count(0)
    page.wait_for_function(SHEET_DRAWN)
    frames.first.click()
    expect(page.get_by_role("region", name="What will happen")).to_contain_text("1 photo of 40 is left out.")
    tab.screenshot("video")
    assert tab.findings() == []


def test_a_long_list_is_shown_piece_by_piece_and_all_of_it_is_live(
    page: Page, service: Running, busy: str
) -> None:
    page.goto(service.url)
    newest = [f"job {number:02}" for number in reversed(range(WAITING))]
    expect(page.locator(".job-card")).to_have_count(24)
    # The oldest of all runs, so it comes first. What a program sent is called after its folder.
    assert names(page) == ["kitchen", *newest[:23]]
    page.get_by_role("button", name="More jobs").click()
    expect(page.locator(".job-card")).to_have_count(48)
    shown = 48
    while (more := page.get_by_role("button", name="More jobs")).is_visible():
        more.click()
        expect(page.locator(".job-card")).not_to_have_count(shown)  # the button goes with the last piece
        shown = page.locator(".job-card").count()
    assert names(page)[: WAITING + 1] == ["kitchen", *newest]
    words = page.locator(".job-card", has_text="kitchen").locator(".run-words")
    expect(words).to_contain_text("look")
    looked = words.inner_text()
    expect(words).not_to_have_text(looked)
    expect(page.locator(".job-card", has_text="job 00").locator(".run-words")).to_contain_text(
        "Number 1 in the queue"
    )


def test_the_list_is_narrowed_to_a_state_and_stays_so_on_the_way_back(
    page: Page, service: Running, busy: str
) -> None:
    page.goto(service.url)
    page.get_by_label("Show").select_option("running")
    expect(page.locator(".job-card")).to_have_count(1)
    page.locator(".job-card").click()
    expect(page.get_by_role("heading", level=1)).to_contain_text("kitchen")
    page.go_back()
    expect(page.locator(".job-card")).to_have_count(1)
    expect(page.get_by_label("Show")).to_have_value("running")
    page.get_by_label("Show").select_option("expired")
    expect(page.get_by_text("No job is expired.")).to_be_visible()
    page.get_by_label("Show").select_option("")
    expect(page.locator(".job-card")).to_have_count(24)


def test_jobs_are_found_sorted_and_cancelled_and_deleted_many_at_once(
    page: Page, service: Running, busy: str, api: httpx.Client
) -> None:
    page.goto(service.url)
    page.get_by_label("Order").select_option("name")
    page.get_by_label("Find").fill("job 1")
    tens = [f"job {number}" for number in range(10, 20)]
    expect(page.locator(".job-card")).to_have_count(10)
    assert names(page) == tens
    for name in tens[:2]:
        page.get_by_label(f"Select {name}", exact=True).check()
    page.get_by_role("region", name="Selected jobs").get_by_role("button", name="Cancel 2").click()
    page.get_by_role("button", name="Cancel and keep nothing").click()
    expect(page.locator(".job-card .chip", has_text="cancelled")).to_have_count(2)
    states = {item["labels"]["name"]: item["state"] for item in api.get("/jobs?limit=200").json()["items"]}
    assert [states[name] for name in tens] == ["cancelled"] * 2 + ["queued"] * 8
    page.get_by_label("Select all", exact=True).check()
    expect(page.get_by_role("region", name="Selected jobs")).to_contain_text("10 jobs selected")
    page.get_by_role("button", name="Delete 2").click()
    page.get_by_role("button", name="Delete them").click()
    expect(page.locator(".job-card")).to_have_count(8)
    assert names(page) == tens[2:]
    page.get_by_label("Find").fill("nosuch")
    expect(page.get_by_text("No job is called “nosuch”.")).to_be_visible()


@pytest.mark.parametrize(("name", "viewport"), [("seeding", DESKTOP), ("phone-seeding", PHONE)])
def test_what_feature_matches_say_is_seen_while_they_are_looked_for(
    browser: Browser, service: Running, busy: str, kitchen: Path, name: str, viewport: dict[str, int]
) -> None:
    with closing(browser.new_context(viewport=viewport)) as context:
        watched = watched_page(context, service.url)
        page = watched.page
        page.goto(f"{service.url}/#/jobs/{busy}")
        said = page.get_by_text(re.compile(r"Features of 10 of 10 photos found; \d+ pairs of photos match"))
        expect(said).to_be_visible()
        page.wait_for_function("() => document.querySelector('.seeding-photos')?.naturalWidth > 0")
        expect(page.get_by_role("img", name="Each photo matches 0 to")).to_be_visible()
        expect(page.get_by_text("no other so far")).to_contain_text("r_9")
        watched.screenshot(name)
        assert watched.findings() == []
        assert not watched.overflows()
        assert watched.complaints == []

"""What a user does: sends a set, watches the job, looks at the result, takes it away."""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, expect

from tests.service.conftest import Running, operator
from tests.web.comparison import expect_compared
from tests.web.conftest import LOOKS_ELSEWHERE, again, another_job, asked_after_reload, curve_steps
from tests.web.download_lines import expect_lines_to_bring_the_same
from tests.web.result_views import expect_photo_over_the_view, expect_ticked_images_in_another_run
from tests.web.sharing import expect_a_link_to_show_the_page_until_it_is_revoked
from tests.web.watched import Watched


def test_progress_is_live_and_a_reload_keeps_the_curves(desktop: Watched, job_url: str) -> None:
    page = desktop.page
    expect(page.get_by_role("img", name="render of one view")).to_be_visible()
    expect(page.get_by_text("Stage 2 begins once this stays between the dashed lines")).to_be_visible()
    bar = page.get_by_role("progressbar", name="Progress of kitchen")
    shown = curve_steps(page)
    share = int(bar.get_attribute("aria-valuenow") or 0)
    desktop.screenshot("job-running")
    assert desktop.findings() == []
    page.wait_for_function(
        "was => Number(document.querySelector('[role=progressbar]').getAttribute('aria-valuenow')) > was",
        arg=share,
    )
    # One bar, as long as the share of the whole run that is done, and what it does now.
    expect(page.get_by_role("progressbar")).to_have_count(1)
    filled = (
        "e => { const [b, f] = [e, e.firstChild]; return [f.style.width, b.getAttribute('aria-valuenow')] }"
    )
    width, now = bar.evaluate(filled)
    assert int(float(width.removesuffix("%"))) == int(now)
    expect(page.locator(".run-words")).to_contain_text(re.compile(r"\d+ % · \d+(\.\d)? (s|min|h) left"))
    page.reload()
    # The page asks for the events again, which takes a moment. Live events alone would begin later.
    while curve_steps(page)[1] < shown[1]:
        page.wait_for_timeout(100)
    assert curve_steps(page)[0] == shown[0]


def test_the_slider_goes_from_the_inputs_poses_to_the_refined_ones(
    desktop: Watched, done: dict[str, Any]
) -> None:
    page = desktop.page
    slider = page.get_by_role("slider", name="From the input's poses to the refined ones")
    slider.press("End")
    refined = (stage := page.get_by_role("application")).screenshot()
    slider.press("Home")
    assert stage.screenshot() != refined
    slider.press("End")
    expect_photo_over_the_view(page)


def test_the_swipe_uncovers_the_view_before_and_the_photo(desktop: Watched, done: dict[str, Any]) -> None:
    page = desktop.page
    frame = page.locator(".compare-frame")
    for mode, left, right in (
        ("test: given | refined", "given poses", "refined poses"),
        ("photo | render", "photo", "render"),
    ):
        page.get_by_role("radio", name=mode).check()
        swipe = page.get_by_role("slider", name=f"Swipe between {left} and {right}")
        swipe.press("Home")
        all_right = frame.screenshot()
        swipe.press("End")
        assert frame.screenshot() != all_right
    for mode in ("difference", "depth"):
        page.get_by_role("radio", name=mode).check()
        picture = page.locator(".compare-figure img").first
        expect(picture).to_be_visible()
        page.wait_for_function("() => document.querySelector('.compare-figure img').naturalWidth > 0")


def test_the_table_sorts_and_chooses(desktop: Watched, done: dict[str, Any]) -> None:
    page = desktop.page
    table = page.get_by_role("region", name="Table of images")
    turned = table.get_by_role("columnheader").filter(has_text="turned")
    turned.get_by_role("button").click()
    turned.get_by_role("button").click()
    place = [text.strip() for text in table.get_by_role("columnheader").all_inner_texts()]
    column = next(n for n, text in enumerate(place) if text.startswith("turned"))
    values = [
        float(row.locator("td, th").nth(column).inner_text()) for row in table.get_by_role("row").all()[1:]
    ]
    assert len(values) == 10
    assert values in (sorted(values), sorted(values, reverse=True))
    table.get_by_role("row").nth(4).get_by_role("button").click()
    expect(table.locator("tr[aria-current]")).to_have_count(1)


def test_ticked_images_are_held_or_left_out_in_another_run(desktop: Watched, done: dict[str, Any]) -> None:
    expect_ticked_images_in_another_run(desktop.page)


def test_the_report_to_open_offline_is_headed_by_the_sets_name(
    done: dict[str, Any], api: httpx.Client
) -> None:
    page = api.get(f"/jobs/{done['id']}/artifacts/report.html", follow_redirects=True).text
    assert done["labels"]["name"] == "kitchen"
    assert "<title>kitchen</title>" in page


def test_the_verdict_is_the_reports(desktop: Watched, done: dict[str, Any], api: httpx.Client) -> None:
    said = api.get(f"/jobs/{done['id']}/report").json()["verdict"]
    assert said["verdict"] == done["verdict"]
    region = desktop.page.get_by_role("region", name="Verdict")
    shown = region.inner_text()
    assert {"improved": "improved", "kept_input": "not improved"}.get(
        said["verdict"], said["verdict"]
    ).lower() in shown.lower()
    desktop.screenshot("job-done")


def test_a_result_leads_with_how_exact_it_is_and_how_many_photos_are_confirmed(
    desktop: Watched, done: dict[str, Any], api: httpx.Client
) -> None:
    images = api.get(f"/jobs/{done['id']}/artifacts/report.json").json()["images"]
    confirmed = sum(bool(image["confirmed"]) for image in images)
    known = any(image["uncertainty"]["rotation_deg"] is not None for image in images)
    region = desktop.page.get_by_role("region", name="Verdict")
    names = [text for text in region.locator("dt").all_inner_texts() if text]
    assert names[: 1 + known] == ["Poses exact to", "Photos confirmed"][1 - known :]
    expect(region.locator(".figures > div", has_text="Photos confirmed")).to_contain_text(
        f"{confirmed} of {len(images)}"
    )
    for researchers in ("Cameras turned by", "Refined cameras differ by", "Final render"):
        expect(region.get_by_text(researchers, exact=True)).to_be_hidden()


def test_a_result_shows_its_render_first_and_not_a_trials(desktop: Watched, done: dict[str, Any]) -> None:
    page = desktop.page
    page.reload()
    expect(page.get_by_role("radio", name="photo | render")).to_be_checked()
    page.wait_for_function("() => document.querySelector('.compare-frame img')?.naturalWidth > 0")
    words = [image.get_attribute("alt") or "" for image in page.locator(".compare-frame img").all()]
    assert [text.split(" ./")[0] for text in words] == ["Render of", "Photo"]


def test_downloads_are_the_artifacts_to_the_byte(desktop: Watched, digests: dict[str, str]) -> None:
    page = desktop.page
    with page.expect_download() as coming:
        page.get_by_role("link", name="Download For nerfstudio").click()
    sent = Path(coming.value.path()).read_bytes()
    assert coming.value.suggested_filename == "transforms_nerfstudio.json"
    assert hashlib.sha256(sent).hexdigest() == digests["transforms_nerfstudio.json"]
    with page.expect_download() as coming:
        page.get_by_role("button", name="Download .zip For COLMAP", exact=True).click()
    with zipfile.ZipFile(io.BytesIO(Path(coming.value.path()).read_bytes())) as archive:
        assert archive.testzip() is None
        found = {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}
    assert found == {name: sha for name, sha in digests.items() if name.startswith("colmap/sparse/")}
    assert found


def test_the_lines_beside_a_download_bring_the_same(
    desktop: Watched, digests: dict[str, str], tmp_path: Path
) -> None:
    expect_lines_to_bring_the_same(desktop.page, digests, tmp_path)


def test_a_form_that_is_not_there_is_written_on_demand(desktop: Watched, done: dict[str, Any]) -> None:
    row = desktop.page.get_by_role("listitem").filter(has_text="For odometry tools")
    row.get_by_role("button", name="Create").click()
    expect(row.get_by_role("link", name="Download For odometry tools")).to_be_visible()
    row.get_by_role("button", name="curl, Python").click()
    expect(row.get_by_label("curl", exact=True)).to_contain_text("/artifacts/kitti.txt")


def test_the_list_shows_the_job_with_its_picture_and_verdict(desktop: Watched, done: dict[str, Any]) -> None:
    page = desktop.page
    page.get_by_role("link", name="Jobs").click()
    card = page.get_by_role("link").filter(has_text="kitchen")
    page.wait_for_function("() => document.querySelector('.job-card img')?.naturalWidth > 0")
    expect(card.locator(".chip")).to_be_visible()
    desktop.screenshot("jobs")
    assert desktop.findings() == []


def test_all_of_it_can_be_reached_by_keyboard(desktop: Watched, done: dict[str, Any]) -> None:
    page = desktop.page
    page.get_by_role("link", name="Jobs").focus()
    reached = []
    for _ in range(30):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.textContent"))
        if "kitchen" in reached[-1]:
            break
    assert "kitchen" in reached[-1], reached
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Downloads")).to_be_visible()
    assert page.evaluate("document.activeElement.tagName") == "MAIN"
    names = set()
    for _ in range(120):
        page.keyboard.press("Tab")
        names.add(
            page.evaluate("document.activeElement.ariaLabel || document.activeElement.textContent.trim()")
        )
    wanted = {
        "Run again …",
        "Delete",
        "From the input's poses to the refined ones",
        "Swipe between photo and render",
    }
    assert wanted <= names, names
    page.get_by_role("button", name="Delete").press("Enter")
    expect(page.get_by_role("dialog", name="Delete this job?")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog", name="Delete this job?")).to_be_hidden()


def test_the_result_is_accessible_and_stayed_at_home(desktop: Watched, done: dict[str, Any]) -> None:
    assert desktop.findings() == []
    assert desktop.outside == []
    assert desktop.complaints == []


def test_a_phone_shows_the_same_without_scrolling_sideways(
    phone: Watched, job_url: str, done: dict[str, Any], service: Running
) -> None:
    page = phone.page
    page.goto(service.url)
    expect(page.locator(".drop-buttons .act", has_text="Choose photos or a video")).to_be_visible()
    expect(page.get_by_text("anywhere on this page")).to_be_hidden()
    for name, url in (("phone-job", job_url), ("phone-jobs", service.url)):
        page.goto(url)
        expect(page.get_by_text("kitchen").first).to_be_visible()
        if name == "phone-job":
            expect(page.get_by_role("slider", name="Swipe between photo and render")).to_be_visible()
            expect(page.locator(".curves canvas").first).to_be_visible()
        phone.screenshot(name)
        assert not phone.overflows(), name
        assert phone.findings() == []
    assert phone.outside == []
    assert phone.complaints == []


def test_a_job_is_run_again_ended_and_deleted(
    tab: Watched, job_url: str, done: dict[str, Any], api: httpx.Client
) -> None:
    page = tab.page
    page.context.grant_permissions(["notifications"])
    page.add_init_script(LOOKS_ELSEWHERE)
    dialog = again(page, job_url)
    dialog.get_by_text("More options").click()
    steps = dialog.get_by_label("Steps", exact=True)
    assert steps.get_attribute("placeholder") == "500"
    steps.fill("20000")
    assert tab.findings() == []
    dialog.get_by_role("button", name="Run from the start").click()
    job = another_job(page, job_url)
    options = api.get(f"/jobs/{job}").json()["options"]
    assert options == {**done["options"], "steps": 20000}
    page.get_by_label("Notify me when it ends").check()
    expect(page.get_by_role("status").filter(has_text="Now: ")).to_have_count(1)  # it has begun
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.get_by_role("button", name="Cancel and keep nothing").click()
    expect(page.get_by_role("heading", level=1)).to_contain_text("cancelled")
    expect(page.get_by_text("Its poses were not kept, so there is no result and no verdict")).to_be_visible()
    expect(page.locator(".run-words")).to_have_text(
        re.compile(r"cancelled (at step \d+ of \d+|while \w+.*), after .*")
    )
    assert page.evaluate("window.told") == ["kitchen: cancelled"]
    page.get_by_role("button", name="Delete", exact=True).click()
    page.get_by_role("button", name="Delete it").click()
    page.wait_for_url("**/#/")
    assert api.get(f"/jobs/{job}").status_code == 404


def test_a_fork_goes_on_after_stage_1_and_its_end_on_request_leaves_a_partial_result(
    tab: Watched, job_url: str, done: dict[str, Any], api: httpx.Client
) -> None:
    page = tab.page
    dialog = again(page, job_url)
    dialog.get_by_text("More options").click()
    dialog.get_by_label("Steps of the verdict", exact=True).fill("100000")  # it would take hours
    dialog.get_by_role("button", name="Continue from").click()
    fork = another_job(page, job_url)
    made = api.get(f"/jobs/{fork}").json()
    assert (made["forked_from"], made["forked_stage"]) == (done["id"], "coarse")
    assert made["options"] == {**done["options"], "trial_steps": 100_000}
    expect(page.get_by_role("img", name="render of one view")).to_be_visible()
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.get_by_role("button", name="Cancel and keep the poses so far").click()
    expect(page.get_by_role("heading", level=1)).to_contain_text("partial result")
    so_far = api.get(f"/jobs/{fork}/artifacts/report.json").json()["verdict_so_far"]
    for words in ("The run was stopped ", "There is no verdict", so_far["why"][0]):
        expect(page.get_by_role("region", name="Verdict")).to_contain_text(words)
    ended = api.get(f"/jobs/{fork}").json()
    assert (ended["state"], ended["partial"], ended["verdict"]) == ("cancelled", True, None)
    with page.expect_download() as coming:
        page.get_by_role("link", name="Download For nerfstudio").click()
    assert len(json.loads(Path(coming.value.path()).read_text())["frames"]) == 10
    page.get_by_text("Options and times").click()
    expect(page.get_by_role("link", name=done["id"])).to_be_visible()
    tab.screenshot("job-partial")
    assert asked_after_reload(page, "/artifacts") == 1
    page.goto(job_url.partition("#")[0])
    expect_compared(page, api, done["id"], fork)
    tab.screenshot("compared")
    assert tab.findings_in_each_look() == []
    assert tab.complaints == []


# Last: from then on the service asks everybody for a key.
def test_a_service_with_keys_is_used_with_one_and_a_result_is_shared_without(
    tab: Watched, browser: Browser, service: Running, job_url: str, done: dict[str, Any], api: httpx.Client
) -> None:
    with ThreadPoolExecutor(1) as aside:  # Playwright's own loop runs in this thread
        made = aside.submit(operator, service.data_dir, "keys", "create", "page", "--tenant", "local")
        key = made.result()["key"]
    page = tab.page
    # The service asks only now and then whether the first key has been made.
    while api.get("/jobs").status_code != 401:
        page.wait_for_timeout(200)
    page.goto(job_url)
    field = page.get_by_label("API key")
    field.fill("brn_wrong")
    field.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("unknown, expired or revoked")
    tab.screenshot("key")
    field.fill(key)
    field.press("Enter")
    page.wait_for_function("() => document.querySelector('.compare-frame img')?.naturalWidth > 0")
    assert page.locator(".compare-frame img").first.get_attribute("src").startswith("blob:")
    with page.expect_download() as coming:
        page.get_by_role("button", name="Download For nerfstudio").click()
    assert coming.value.suggested_filename == "transforms_nerfstudio.json"
    page.reload()
    expect(page.get_by_role("heading", name="Downloads")).to_be_visible()
    expect_a_link_to_show_the_page_until_it_is_revoked(browser, page, service.url)
    assert tab.outside == []

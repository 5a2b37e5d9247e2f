"""report.html in a real browser, from disk, without network: what it shows is what the files say."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from scipy.stats import chi2

from biresnerf.geometry.rigid import interpolate_pose
from biresnerf.uncertainty import PartReport, PartsReport, PoseUncertainty, SeamReport
from biresnerf.viewer.report_html import write_report_html
from tests.viewer.conftest import ARGUMENTS, CHROMIUM, HOSTILE, HOSTILE_IMAGE, SCREENSHOTS, VIEWS, open_report

STAGE = "document.querySelector('.scene-stage').dataset"  # what is really drawn
CHOSEN = "(document.querySelector('.images tr[aria-current]')?.dataset.image ?? '')"  # what the table says
WIDGETS = (".verdict", ".scene canvas", ".compare", ".images tbody tr", ".curve canvas")


def stage(page) -> dict[str, str]:
    return page.evaluate(f"() => ({{...{STAGE}}})")


def choose(page, image: int) -> None:
    """By the keyboard, as someone without a mouse does."""
    page.locator(".scene-stage").focus()
    for _ in range(VIEWS + 1):
        # The picture is drawn after the page: what it still shows of the last choice is not where a key begins.
        page.wait_for_function(f"() => {STAGE}.selected === {CHOSEN}")
        before = stage(page)["selected"]
        if before == str(image):
            return
        page.keyboard.press("ArrowRight")
        page.wait_for_function(f"() => {STAGE}.selected !== '{before}'")
    raise AssertionError(f"image {image} was not reached")


def slide(page, share: float) -> None:
    page.get_by_label("From the input's poses to the refined ones").fill(str(share))
    page.wait_for_function(f"() => Number({STAGE}.share) === {share}")


def test_all_widgets_are_there_and_nothing_is_loaded_from_elsewhere(opened, result):
    for widget in WIDGETS:
        opened.page.wait_for_selector(widget)
    assert opened.complaints == []
    own = (result.folder / "report.html").as_uri()
    assert {url for url in opened.asked if not url.startswith(("data:", "blob:"))} == {own}


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_the_slider_moves_the_drawn_cameras_along_the_way_between_the_poses(opened, result, share):
    page = opened.page
    slide(page, share)
    for image in (HOSTILE_IMAGE, VIEWS - 1):
        choose(page, image)
        before, after = result.pose(image, "world_from_cam_before"), result.pose(image)
        assert np.linalg.norm(before[:3, 3] - after[:3, 3]) > 1e-3
        drawn = np.array([float(value) for value in stage(page)["centre"].split()])
        np.testing.assert_allclose(drawn, interpolate_pose(before, after, share)[:3, 3], atol=1e-5)
    slide(page, 1)


def test_a_click_chooses_the_camera_under_it(opened):
    page = opened.page
    places = {}
    for image in range(VIEWS):
        choose(page, image)
        places[image] = tuple(float(value) for value in stage(page)["onScreen"].split())
    apart = {
        image: min(np.hypot(x - u, y - v) for other, (u, v) in places.items() if other != image)
        for image, (x, y) in places.items()
    }
    box = page.locator(".scene-stage").bounding_box()
    seen = [
        image for image, (x, y) in places.items() if 0 < x < box["width"] - 2 and 0 < y < box["height"] - 2
    ]
    assert len(seen) >= VIEWS // 2
    image = max(seen, key=apart.get)
    choose(page, (image + 1) % VIEWS)
    page.locator(".scene-stage").click(position=dict(zip("xy", places[image], strict=True)))
    page.wait_for_function(f"() => {STAGE}.selected === '{image}'")


def test_a_click_on_a_heading_sorts_the_table_and_another_turns_it_round(opened, result):
    page, heading = opened.page, opened.page.get_by_role("button", name="turned °")
    moved = [image.moved_deg for image in result.report.images]
    heading.click()
    assert table(page) == sorted(range(VIEWS), key=lambda image: -moved[image])
    assert page.locator("th", has=heading).get_attribute("aria-sort") == "descending"
    heading.click()
    assert table(page) == sorted(range(VIEWS), key=lambda image: moved[image])


def test_the_table_finds_images_by_name(opened):
    page = opened.page
    page.get_by_label("Find").fill("r_7")
    assert table(page) == [7]
    page.get_by_label("Find").fill("")
    assert len(table(page)) == VIEWS


def table(page) -> list[int]:
    return [int(row.get_attribute("data-image")) for row in page.locator(".images tbody tr").all()]


def test_a_hostile_name_stays_text(opened):
    page = opened.page
    assert page.locator(".images .link", has_text=HOSTILE).text_content() == HOSTILE
    assert page.evaluate(
        "() => [window.hit ?? null, document.querySelectorAll('img[src=\"x\"]').length]"
    ) == [None, 0]


def test_a_camera_without_a_render_says_so_and_names_the_nearest(opened, result):
    page = opened.page
    shown = [view["image"] for view in result.view["views"]]
    image = next(i for i in range(VIEWS) if i not in shown and i != HOSTILE_IMAGE)
    choose(page, image)
    said = page.locator(".compare .notice")
    assert f"was not rendered: {len(shown)} of {VIEWS} views were" in said.text_content()
    centres = [result.pose(i)[:3, 3] for i in range(VIEWS)]
    nearest = min(shown, key=lambda other: np.linalg.norm(centres[other] - centres[image]))
    first = said.locator(".link").first
    assert first.text_content() == result.report.images[nearest].name
    first.click()
    assert page.locator(".compare-frame img").count() == 2


def test_the_swipe_is_worked_by_keys_and_uncovers_the_render(opened, result):
    page = opened.page
    choose(page, result.view["views"][0]["image"])
    page.get_by_role("radio", name="photo | render").check()
    page.get_by_label("Swipe between photo and render").focus()
    for key, uncovered in (("Home", 0), ("End", 1)):
        page.keyboard.press(key)
        page.wait_for_function(
            f"() => document.querySelector('.compare-frame input').value === '{uncovered}'"
        )
        photo, render = (
            page.locator(".compare-frame").bounding_box(),
            page.locator(".compare-edge").bounding_box(),
        )
        edge = render["x"] + render["width"] / 2
        covering = page.locator(".compare-frame img").nth(1)
        assert covering.get_attribute("alt").startswith("Photo")
        assert f"{100 - 100 * uncovered}%" in covering.evaluate("e => e.style.clipPath")
        assert abs(edge - (photo["x"] + uncovered * photo["width"])) < 1
    for kind in ("difference", "depth"):
        page.get_by_role("radio", name=kind).check()
        assert page.locator(".compare-frame img").evaluate("e => e.decode().then(() => e.naturalWidth)") == 32
    page.get_by_role("radio", name="photo | render").check()


def test_the_verdict_is_said_with_its_figures(opened, result):
    text = " ".join(opened.page.locator(".verdict").text_content().split())
    verdict = result.report.verdict
    assert verdict.why[0] in text
    assert f"{verdict.heldout.psnr.before:.2f} → {verdict.heldout.psnr.after:.2f}" in text


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("device", "width", "height"), [("desktop", 1400, 900), ("phone", 360, 780)])
def test_no_serious_fault_of_accessibility_and_nothing_wider_than_the_screen(
    browser, result, axe, scheme, device, width, height
):
    size = {"width": width, "height": height}
    opened = open_report(browser, result.folder / "report.html", color_scheme=scheme, viewport=size)
    page = opened.page
    page.wait_for_selector(".curve canvas")
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"report-{device}-{scheme}.png", full_page=True)
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    page.evaluate(axe)
    found = page.evaluate("() => axe.run()")["violations"]
    serious = [(f["id"], f["nodes"][0]["html"]) for f in found if f["impact"] in ("serious", "critical")]
    assert serious == []
    page.context.close()


ROOT = np.array([[0.004, 0, 0], [0.001, 0.003, 0], [0.002, -0.001, 0.005]])
UNKNOWN_IMAGE = 4


@pytest.fixture(name="stated", scope="module")
def stated_page(browser, result, tmp_path_factory):
    """The report of a result with the same covariance of all poses but one, of which nothing is known."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = ROOT @ ROOT.T
    known = PoseUncertainty(
        known_from="matches",
        rotation_deg=0.031,
        position=0.0123,
        position_percent=0.3,
        covariance=covariance.tolist(),
    )
    unknown = PoseUncertainty(known_from="nothing", why_unknown="nothing speaks for it")
    images = tuple(
        image.model_copy(update={"uncertainty": unknown if number == UNKNOWN_IMAGE else known})
        for number, image in enumerate(result.report.images)
    )
    folder = tmp_path_factory.mktemp("stated") / "out"
    shutil.copytree(result.folder, folder)
    parts = PartsReport(
        parts=(
            PartReport(name="a", photos=6), PartReport(name="b", photos=6),
            PartReport(name="c", photos=3, why_not="no"),
        ),
        seams=(
            SeamReport(
                parts=("a", "b"), photos=2, rotation_deg=0.021, rotation_deg_worst=0.43, position=1, position_worst=2
            ),
        ),
        part_of=(0,) * 5 + (1,) * (len(images) - 5),
        apart_deg=(None,) * 4 + (0.43, 0.01) + (None,) * (len(images) - 6),
    )  # fmt: skip
    write_report_html(folder, result.report.model_copy(update={"images": images, "parts": parts}))
    opened = open_report(browser, folder / "report.html")
    yield opened.page
    opened.page.context.close()


def test_the_page_says_how_well_the_parts_agree_that_a_set_was_joined_from(stated, opened):
    def said(page) -> dict[str, list[str]]:
        page.get_by_text("More figures").click()
        terms = page.locator(".verdict details .figures > div").filter(visible=True).all()
        return {term.locator("dt").text_content(): term.locator("dd").all_text_contents() for term in terms}

    assert said(stated)["Parts agree to"] == [
        "0.021°",
        "on shared photos, 0.43° at most (a, b); 2 of 3 parts joined",
    ]
    assert "Parts agree to" not in said(opened.page)


def test_the_map_shows_the_parts_and_where_they_disagree(stated, opened):
    def offered(page) -> list[str]:
        return page.get_by_label("Colour").locator("option").all_text_contents()

    assert offered(stated) == [*offered(opened.page), "part", "parts disagree (°)"]
    stated.get_by_label("Colour").select_option("part")
    legend = stated.locator(".scene .legend")
    assert [entry.text_content().strip() for entry in legend.locator("li").all()] == ["a", "b"]
    stated.get_by_label("Colour").select_option("parts_apart_deg")
    assert "in one part" in legend.text_content()
    assert "≥ 0.1" in legend.text_content()


def test_the_table_says_how_exact_each_pose_is_and_finds_those_not_known(stated):
    heading = stated.get_by_role("button", name="exact to °")
    column = [cell.text_content() for cell in stated.locator(".images thead th").all()].index("exact to °")
    said = [
        row.locator("th, td").nth(column).text_content() for row in stated.locator(".images tbody tr").all()
    ]
    assert said == ["not known" if image == UNKNOWN_IMAGE else "± 0.0310" for image in range(VIEWS)]
    heading.click()
    assert table(stated)[-1] == UNKNOWN_IMAGE
    stated.locator(".images").get_by_label("Show").select_option(label="pose not known")
    assert table(stated) == [UNKNOWN_IMAGE]
    stated.locator(".images").get_by_label("Show").select_option(label="all")


def test_drawn_ellipsoids_hold_nine_in_ten_errors_so_many_times_too_large(stated, result):
    switch = stated.get_by_label("Uncertainty ×10")
    assert switch.count() == 1
    assert not switch.is_checked()  # ellipsoids hide the scene
    switch.check()
    choose(stated, 1)
    drawn = np.array(stage(stated)["uncertainty"].replace(",", " ").split(), float).reshape(3, 3)
    key = "world_from_cam_before" if result.report.verdict.returned == "input" else "world_from_cam"
    apart = (drawn - result.pose(1, key)[:3, 3]) / 10
    held = np.einsum("ka,ab,kb->k", apart, np.linalg.inv(ROOT @ ROOT.T), apart)
    np.testing.assert_allclose(held, chi2.ppf(0.9, 3), rtol=1e-3)
    choose(stated, UNKNOWN_IMAGE)
    assert stage(stated)["uncertainty"] == ""
    choose(stated, 1)
    switch.uncheck()
    stated.wait_for_function(f"() => {STAGE}.uncertainty === ''")


def test_without_webgl_the_cameras_are_listed_in_a_table(result, browser):
    blind = browser.browser_type.launch(executable_path=str(CHROMIUM), args=[*ARGUMENTS, "--disable-3d-apis"])
    page = open_report(blind, result.folder / "report.html").page
    rows = page.locator(".scene tbody tr")
    assert rows.count() == VIEWS
    assert "no WebGL" in page.locator(".scene .notice").text_content()
    blind.close()


def test_looking_through_a_camera_puts_it_in_the_middle_and_overview_goes_back(opened):
    page = opened.page
    choose(page, 0)
    overview = stage(page)["onScreen"]
    page.locator(".scene-stage").focus()
    page.keyboard.press("Enter")
    button = page.get_by_role("button", name="Look through")
    page.wait_for_function("e => e.getAttribute('aria-pressed') === 'true'", arg=button.element_handle())
    slide(page, 0.5)
    slide(page, 1)
    assert stage(page)["onScreen"] == ""  # the eye is where the camera is: it has no place before it
    page.get_by_role("button", name="Overview").click()
    slide(page, 0.5)
    slide(page, 1)
    seen, before = (
        np.array([float(v) for v in text.split()]) for text in (stage(page)["onScreen"], overview)
    )
    np.testing.assert_allclose(seen, before, atol=2)

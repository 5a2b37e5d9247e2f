"""Parts of a photo masked in the browser: what is painted is what the service stores and its job gets."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import time
from pathlib import Path

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from tests.service.conftest import Running
from tests.web.conftest import check_row, drop
from tests.web.watched import Watched

PHOTO, SIZE = "train/r_3", 40
# Rows and columns of a passer-by in one colour.
AWAY = (slice(6, 18), slice(20, 31))


@pytest.fixture
def passed_by(kitchen: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "street"
    shutil.copytree(kitchen, folder)
    with Image.open(folder / f"{PHOTO}.png") as photo:
        pixels = np.array(photo.convert("RGBA"))
    assert pixels.shape[:2] == (SIZE, SIZE)
    pixels[AWAY] = (230, 0, 230, 255)
    Image.fromarray(pixels).save(folder / f"{PHOTO}.png")
    return folder


def expected() -> NDArray[np.bool_]:
    away = np.zeros((SIZE, SIZE), dtype=bool)
    away[AWAY] = True
    return away


def opened(page: Page) -> tuple[Locator, Locator]:
    """The dialog of the photo, and where one paints."""
    page.get_by_role("radio", name="masks parts of it").check()
    page.get_by_role("button", name=f"Mask ./{PHOTO}").click()
    dialog = page.get_by_role("dialog", name=f"Mask ./{PHOTO}")
    stage = dialog.get_by_role("application")
    expect(stage).to_be_visible()
    return dialog, stage


def painted(stage: Locator) -> NDArray[np.bool_]:
    """What the canvas shows as masked."""
    look = "e => [...e.getContext('2d').getImageData(0, 0, e.width, e.height).data].filter((_, i) => i % 4 === 3)"
    return np.array(stage.evaluate(look)).reshape(SIZE, SIZE) > 0


def at(stage: Locator, row: float, column: float) -> tuple[float, float]:
    box = stage.bounding_box()
    assert box is not None
    return box["x"] + box["width"] * column / SIZE, box["y"] + box["height"] * row / SIZE


def test_an_area_is_masked_by_its_colour_and_neither_the_set_nor_its_job_uses_it(
    tab: Watched, service: Running, passed_by: Path, api: httpx.Client
) -> None:
    page = tab.page
    page.goto(service.url)
    drop(page, passed_by)
    page.get_by_text("A first result within minutes").click()
    dialog, stage = opened(page)
    assert not painted(stage).any()
    dialog.get_by_role("radio", name="Fill by colour").check()
    page.mouse.click(*at(stage, 12, 25))
    np.testing.assert_array_equal(painted(stage), expected())
    expect(dialog.get_by_role("status")).to_have_text("9 % masked")
    tab.screenshot("mask", full=False)
    assert tab.findings_in_each_look() == []
    dialog.get_by_role("button", name="Use this mask").click()
    submit = page.get_by_role("button", name="Refine the poses")
    expect(submit).to_be_disabled()
    before = page.url
    page.get_by_role("button", name="Save 1 mask").click()
    page.wait_for_url(lambda url: "#/datasets/" in url and url != before)
    expect(check_row(page, "Masks")).to_contain_text("1 mask")
    expect(page.get_by_role("heading", level=1)).to_have_text("street, masked")
    expect(page.get_by_role("radio", name="A first result within minutes")).to_be_checked()

    masked = page.url.rpartition("/")[2]
    sent = {file["path"] for file in api.get(f"/datasets/{before.rpartition('/')[2]}/files").json()["items"]}
    files = {file["path"] for file in api.get(f"/datasets/{masked}/files").json()["items"]}
    assert files == sent | {"train/dynamic_mask_r_3.png"}
    shown = api.get(f"/datasets/{masked}/photos/{place_of(api, masked)}/mask.png").content
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(shown))), ~expected())

    with page.expect_response(lambda answer: answer.url.endswith("/v1/jobs")) as answer:
        submit.click()
    job = answer.value.json()["id"]
    # instant-ngp's way: black pixels count, all others do not.
    np.testing.assert_array_equal(mask_of_job(service, job) > 0, expected())
    api.post(f"/jobs/{job}/cancel")
    assert tab.complaints == []


def place_of(api: httpx.Client, dataset: str) -> int:
    photos = api.get(f"/datasets/{dataset}/photos").json()["photos"]
    (place,) = [index for index, photo in enumerate(photos) if photo["masked"]]
    assert photos[place]["name"] == f"./{PHOTO}"
    return place


def mask_of_job(service: Running, job: str) -> NDArray[np.uint8]:
    """The mask in the folder in which the job runs, once it has been copied there whole."""
    deadline = time.monotonic() + 480
    while time.monotonic() < deadline:
        for path in service.data_dir.rglob("dynamic_mask_r_3.png"):
            if job in str(path):
                with contextlib.suppress(OSError), Image.open(path) as mask:
                    return np.asarray(mask.convert("L"))
        time.sleep(0.05)
    raise AssertionError("the job never got the mask")


def test_a_brush_paints_and_erases_by_mouse_and_keyboard_and_a_saved_mask_is_changed(
    tab: Watched, service: Running, passed_by: Path, api: httpx.Client
) -> None:
    page = tab.page
    page.goto(service.url)
    drop(page, passed_by)
    dialog, stage = opened(page)
    dialog.get_by_role("slider", name="Brush").press("End")
    page.mouse.move(*at(stage, 30, 8))
    page.mouse.down()
    page.mouse.move(*at(stage, 30, 32), steps=3)
    page.mouse.up()
    drawn = painted(stage)
    assert drawn[30, 8:32].all()
    assert not drawn[:24].any()
    rows = np.flatnonzero(drawn[:, 20])
    assert (rows[0] + rows[-1]) / 2 == pytest.approx(29.5, abs=1), "as wide above the line as below"
    dialog.get_by_role("radio", name="Erase").check()
    page.mouse.click(*at(stage, 30, 20))
    erased = painted(stage)
    assert not erased[30, 20]
    assert not (erased & ~drawn).any()
    dialog.get_by_role("button", name="Undo").click()
    np.testing.assert_array_equal(painted(stage), drawn)
    dialog.get_by_role("button", name="Clear").click()
    assert not painted(stage).any()

    dialog.get_by_role("radio", name="Paint").check()
    stage.focus()
    for _ in range(40):
        page.keyboard.press("ArrowUp")
    page.keyboard.press("Shift+ArrowRight")
    by_keys = painted(stage)
    assert by_keys[0, 20]
    assert not by_keys[12:].any()
    dialog.get_by_role("checkbox", name=re.compile("For the 9 other photos")).check()
    dialog.get_by_role("button", name="Use this mask").click()
    page.get_by_role("button", name="Save 10 masks").click()
    expect(check_row(page, "Masks")).to_contain_text("10 masks")
    dialog, stage = opened(page)
    np.testing.assert_array_equal(painted(stage), by_keys)
    dialog.get_by_role("button", name="Clear").click()
    dialog.get_by_role("button", name="Use this mask").click()
    before = page.url
    page.get_by_role("button", name="Save 1 mask").click()
    page.wait_for_url(lambda url: "#/datasets/" in url and url != before)
    expect(check_row(page, "Masks")).to_contain_text("10 masks")
    dialog, stage = opened(page)
    assert not painted(stage).any()
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    assert tab.complaints == []

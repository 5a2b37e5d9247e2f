"""The view through a camera of a result, with its photo laid over it."""

from __future__ import annotations

from playwright.sync_api import Page, expect


def expect_photo_over_the_view(page: Page) -> None:
    """It can be faded in and out while one looks through the camera, and no longer."""
    stage, look = page.get_by_role("application"), page.get_by_role("button", name="Look through")
    look.click()
    fade = page.get_by_role("slider", name="Photo over the view")
    fade.press("Home")
    page.wait_for_timeout(600)  # the flight into the camera ends
    bare = stage.screenshot()
    fade.press("End")
    while stage.screenshot() == bare:  # until the photo has arrived
        page.wait_for_timeout(100)
    page.get_by_role("button", name="Overview").click()
    expect(fade).to_be_hidden()
    expect(look).to_have_attribute("aria-pressed", "false")

"""What the views of a result do: the photo over the view through its camera, and images chosen for another run."""

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


def expect_ticked_images_in_another_run(page: Page) -> None:
    """Two of them are kept fixed or left out there."""
    names = ("./train/r_3", "./train/r_8")
    for name in names:
        page.get_by_label(f"Select {name}", exact=True).check()
    dialog = page.get_by_role("dialog", name="Run again with other options")
    for button, field in (
        ("Run again with their given poses fixed", "Photos to keep fixed"),
        ("Run again without them", "Photos to leave out"),
    ):
        page.get_by_role("button", name=button).click()
        expect(dialog.get_by_label(field, exact=True)).to_have_value(", ".join(names))
        page.keyboard.press("Escape")
        expect(dialog).to_be_hidden()

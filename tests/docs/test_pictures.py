"""The pictures of the pages: each is used, made by a command of the repository, small, and described in words."""

from __future__ import annotations

import re

from docs.generate.pages import GENERATED, ROOT
from docs.generate.pictures import moving_cameras, refined_scene, result_pictures, screenshots
from tests.docs.documented import PAGES

FOLDER = ROOT / "docs/pictures"
MOST_BYTES = 120_000  # of a picture of the page
SHOWN = re.compile(r"!\[([^\]]*)\]\(([^)#]+)\)")


def shown_pictures():
    """The words and the file of each picture that a page shows."""
    for page in PAGES:
        for words, path in SHOWN.findall(page.read_text("utf-8")):
            yield words, (page.parent / path).resolve()


def test_a_command_makes_each_picture_and_a_page_shows_it():
    drawn = {path for path in GENERATED if path.parent == FOLDER}
    made = drawn | {
        refined_scene.BEFORE_AFTER,
        refined_scene.FLIGHT,
        *result_pictures.PICTURES,
        *screenshots.SCREENSHOTS.values(),
    }
    made.add(moving_cameras.CAMERAS)
    assert {path for path in FOLDER.iterdir() if path.is_file()} == made
    assert made == {path for _, path in shown_pictures() if path.parent == FOLDER}


def test_each_picture_is_said_in_words():
    assert [path.name for words, path in shown_pictures() if len(words.split()) < 2] == []


def test_a_picture_of_the_page_is_small():
    sizes = {path.name: path.stat().st_size for path in screenshots.SCREENSHOTS.values()}
    assert {name: size for name, size in sizes.items() if size > MOST_BYTES} == {}

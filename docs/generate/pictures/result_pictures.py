"""The pictures of docs/results.md: `python -m docs.generate.pictures.result_pictures` draws the page's finished example.

Takes a minute. Writes docs/pictures/report.webp, the report.html in Chromium, and evaluate.svg, the errors by
`biresnerf evaluate --plot`.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

import biresnerf
from biresnerf.commands.poses.evaluate import evaluate_command
from biresnerf.commands.poses.make_scene import make_scene
from biresnerf.viewer.report_html import REPORT_HTML, read_report, write_report_html
from docs.generate.pictures.screenshots import (
    FOLDER,
    HEIGHT,
    KIND,
    NAME,
    NOISE,
    SEED,
    SIZE,
    VIEWS,
    WIDTH,
    chromium_of,
    save_screenshot,
)
from service.web_page import EXAMPLE

REPORT, ERRORS = PICTURES = (FOLDER / "report.webp", FOLDER / "evaluate.svg")
SETTLING_MS = 8_000
OPENGL_FROM_OPENCV = np.diag([1.0, -1, -1, 1])


def main() -> None:
    """Draw both pictures."""
    with tempfile.TemporaryDirectory() as temporary:
        draw_errors(Path(temporary))
        draw_report(Path(temporary))


def draw_errors(temporary: Path) -> None:
    """Draw each image's errors before and after, with the example's scene as truth."""
    scene, refined = temporary / NAME, temporary / "refined.json"
    truth = make_scene(scene, KIND, views=VIEWS, size=SIZE, noise=NOISE, seed=SEED).truth
    result = biresnerf.load(EXAMPLE)
    # Of the result's files with poses, the example keeps only poses.json.
    poses = dict(zip(result.names, result.poses @ OPENGL_FROM_OPENCV, strict=True))
    document = json.loads(truth.read_text("utf-8"))
    for frame in document["frames"]:
        frame["transform_matrix"] = poses[frame["file_path"]].tolist()
    refined.write_text(json.dumps(document), "utf-8")
    evaluate_command.main(
        [str(refined), str(truth), "--before", str(scene), "--plot", str(ERRORS)], standalone_mode=False
    )


def draw_report(temporary: Path) -> None:
    """The top of report.html, opened from disk."""
    result = temporary / "result"
    shutil.copytree(EXAMPLE, result)
    for warning in write_report_html(result, read_report(result), title=NAME):
        raise SystemExit(warning)
    with sync_playwright() as playwright:
        browser = chromium_of(playwright)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto((result / REPORT_HTML).as_uri())
        page.wait_for_timeout(SETTLING_MS)
        save_screenshot(page, REPORT)
        browser.close()


if __name__ == "__main__":
    main()

"""One small real run whose report.html is looked at, and Chromium to look with."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.synthetic.scene import synthetic_cameras, write_synthetic_scene
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.verdict import evaluate
from biresnerf.report import Report
from biresnerf.viewer.report_html import BUNDLE

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

VIEWS, SHOWN = 10, 3
HOSTILE = "</script><img src=x onerror=window.hit=1>"  # a path: the folder `<`, and a name in it
HOSTILE_IMAGE = 2
OPTIONS = RefineOptions(
    preset="fast", device="cpu", start="given", steps=200, max_image_size=32, samples_per_step=2048, holdout=1,
    table_size_log2=12, reconstruction_levels=2, trial_steps=10, orbit_frames=2, shown_views=SHOWN, check_every=10,
)  # fmt: skip
CHROMIUM = Path(os.environ.get("BIRESNERF_TEST_CHROMIUM", "/usr/bin/chromium"))
# WebGL without a GPU, and the page painted without either: a sixth of the work.
ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SCREENSHOTS = Path(__file__).resolve().parents[2] / "build" / "screenshots"
BUILT = (BUNDLE / "report.js").is_file()


@dataclass(frozen=True)
class Result:
    """A finished run."""

    scene: Path
    folder: Path
    report: Report
    poses: dict[str, Any]
    view: dict[str, Any]

    def pose(self, image: int, key: str = "world_from_cam") -> np.ndarray:
        return np.array([*self.poses["images"][image][key], [0, 0, 0, 1]])


@pytest.fixture(scope="session")
def result(tmp_path_factory) -> Result:
    scene, folder = tmp_path_factory.mktemp("scene"), tmp_path_factory.mktemp("results") / "out"
    path = write_synthetic_scene(scene, VIEWS, 32, seed=1)
    document = json.loads(path.read_text())
    frame = document["frames"][HOSTILE_IMAGE]
    (scene / f"{HOSTILE}.png").parent.mkdir()
    (scene / frame["file_path"]).with_suffix(".png").rename(scene / f"{HOSTILE}.png")
    frame["file_path"] = HOSTILE
    path.write_text(json.dumps(document))
    dataset = read_dataset(path)
    write_transforms(dataset, perturb_poses(synthetic_cameras(VIEWS, seed=1), 0.15, seed=6), path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "SHOWN_SHARE", 1.0)  # so short a run would leave views out on a busy machine
        report = refine_poses(scene, folder, OPTIONS)
    view = json.loads((folder / "view.json").read_text())
    return Result(scene, folder, report, json.loads((folder / view["poses"]).read_text()), view)


# Not of the session: its event loop runs in the main thread, where other folders' tests want their own.
@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    if not BUILT:
        pytest.skip("The viewer is not built; make web builds it.")
    if not CHROMIUM.is_file():
        pytest.skip(f"There is no {CHROMIUM}; on Debian: apt install chromium")
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        yield browser
        browser.close()


@dataclass
class Opened:
    """report.html in a browser without network, and what it asked for or complained of."""

    page: Page
    asked: list[str]
    complaints: list[str]


def open_report(browser: Browser, path: Path, **context: Any) -> Opened:
    """The page as a reader opens it from disk."""
    context = {"viewport": {"width": 1400, "height": 900}, "reduced_motion": "reduce", **context}
    page = browser.new_context(offline=True, **context).new_page()
    opened = Opened(page, [], [])
    page.set_default_timeout(120_000)
    page.on("request", lambda request: opened.asked.append(request.url))
    page.on("console", lambda said: opened.complaints.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: opened.complaints.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_selector(".job-view")
    return opened


@pytest.fixture(scope="module")
def opened(browser, result) -> Iterator[Opened]:
    opened = open_report(browser, result.folder / "report.html")
    yield opened
    opened.page.context.close()


@pytest.fixture(scope="session")
def axe() -> str:
    """axe-core's script."""
    path = Path(__file__).resolve().parents[2] / "node_modules" / "axe-core" / "axe.min.js"
    if not path.is_file():
        pytest.skip("axe-core is not installed; make web installs it.")
    return path.read_text("utf-8")

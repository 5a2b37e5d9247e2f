"""What a run leaves for pages: views spread over the set, small photos, points on what the views show."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.show.view_file import read_view_file
from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.errors import Interrupted
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.views.shown_views import spread_views
from biresnerf.viewer import report_html
from biresnerf.viewer.report_html import read_report, write_report_html
from tests.viewer.conftest import BUILT, OPTIONS, SHOWN

pytestmark = pytest.mark.slow

built = pytest.mark.skipif(not BUILT, reason="The viewer is not built; make web builds it.")


def test_further_views_are_spread_and_none_is_shown_twice():
    poses = synthetic_cameras(40, seed=2)
    views = spread_views(poses, [3, 17], 6)
    assert len({3, 17, *views}) == 8
    assert spread_views(poses[:4], [0], 9) == spread_views(poses[:4], [0], 3)
    centres = poses[[3, 17, *views], :3, 3]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + 1e9 * np.eye(8)
    everything = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2) + 1e9 * np.eye(40)
    assert apart.min(1).mean() > 2 * everything.min(1).mean()


def test_held_out_views_and_as_many_others_as_asked_are_rendered(result):
    views = result.view["views"]
    assert [view["held_out"] for view in views] == [True] + [False] * SHOWN
    held_out = [i for i, image in enumerate(result.report.images) if image.held_out]
    assert [view["image"] for view in views if view["held_out"]] == held_out
    assert views[0]["psnr"] == result.report.images[held_out[0]].psnr
    for view in views:
        for file in filter(None, view["pictures"].values()):
            with Image.open(result.folder / file) as picture:
                assert picture.size == (view["width"], view["height"])


def test_each_cell_of_the_contact_sheet_shows_its_photo(result):
    sheet = result.view["contact_sheet"]
    whole = np.asarray(Image.open(result.folder / sheet["file"]).convert("RGB"), np.float64)
    width, height = sheet["cell_width"], sheet["cell_height"]
    for view in result.view["views"]:
        row, column = divmod(view["image"], sheet["columns"])
        cell = whole[row * height : (row + 1) * height, column * width : (column + 1) * width]
        photo = np.asarray(Image.open(result.folder / view["pictures"]["photo"]).convert("RGB"), np.float64)
        assert np.abs(cell - photo).mean() < 12  # JPEG


def test_every_point_lies_where_a_shown_view_sees_its_colour(result):
    (entry,) = [points for points in result.view["points"] if points["source"] == "field"]
    content = (result.folder / entry["file"]).read_bytes()
    count = entry["count"]
    assert len(content) == 15 * count > 0
    positions = np.frombuffer(content[: 12 * count], "<f4").reshape(-1, 3) + np.array(entry["origin"])
    colours = np.frombuffer(content[12 * count :], np.uint8).reshape(-1, 3).astype(int)
    found = np.zeros(count, dtype=bool)
    for view in result.view["views"]:
        render = np.asarray(Image.open(result.folder / view["pictures"]["render"])).astype(int)
        camera = result.poses["cameras"][result.poses["images"][view["image"]]["camera"]]
        in_cam = np.linalg.inv(result.pose(view["image"])) @ np.vstack([positions.T, np.ones(count)])
        focal = camera["params"][0] * view["width"] / camera["width"]
        x, y = focal * in_cam[:2] / in_cam[2] + np.array([[view["width"]], [view["height"]]]) / 2
        centred = (np.abs(x % 1 - 0.5) < 0.02) & (np.abs(y % 1 - 0.5) < 0.02) & (in_cam[2] > 0)
        inside = centred & (x > 0) & (y > 0) & (x < view["width"]) & (y < view["height"])
        here = np.flatnonzero(inside)
        seen = render[y[here].astype(int), x[here].astype(int)]
        found[here] |= np.abs(seen - colours[here]).max(axis=1) <= 1
    assert found.mean() > 0.99


@built
def test_what_does_not_fit_is_left_out_and_said(result, tmp_path, monkeypatch):
    folder = copy_of(result.folder, tmp_path)
    monkeypatch.setattr(report_html, "MOST_BYTES", 6000)
    assert write_report_html(folder, result.report) == ()
    page = (folder / "report.html").read_text()
    assert "pictures, beyond 0.006 MB" in page
    assert page.count("data:image/jpeg;base64,") < 4 * len(result.view["views"])


def test_without_the_viewer_nothing_is_written_and_it_is_said(result, tmp_path, monkeypatch):
    folder = copy_of(result.folder, tmp_path)
    (folder / "report.html").unlink(missing_ok=True)
    monkeypatch.setattr(report_html, "BUNDLE", tmp_path / "nowhere")
    (said,) = write_report_html(folder, result.report)
    assert "not built" in said
    assert not (folder / "report.html").exists()


@built
def test_the_page_is_written_again_from_the_folder(result, tmp_path):
    folder = copy_of(result.folder, tmp_path)
    (folder / "report.html").unlink()
    assert write_report_html(folder, read_report(folder), "Kitchen & <hall>") == ()
    assert "<title>Kitchen &amp; &lt;hall&gt;</title>" in (folder / "report.html").read_text()


def test_a_line_of_stage_1_says_what_the_detector_saw(result):
    lines = (result.folder / "history.jsonl").read_text().splitlines()
    coarse = [line for line in lines if '"coarse"' in line]
    assert coarse
    assert all("confirmed" in line for line in coarse)
    assert all("confirmed" not in line for line in lines if line not in coarse)


def copy_of(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "out")


def test_a_stopped_run_leaves_a_page_of_what_there_is(result, tmp_path):
    steps = iter(range(30))
    with pytest.raises(Interrupted):
        refine_poses(result.scene, tmp_path / "out", OPTIONS, should_stop=lambda: next(steps, None) is None)
    view = read_view_file(tmp_path / "out")
    assert view.views == ()
    assert (tmp_path / "out" / view.thumbnail).is_file()
    assert view.contact_sheet is not None
    if BUILT:
        assert '"state":"partial"' in (tmp_path / "out" / "report.html").read_text()

"""The live view of a real viser server, as a client receives it over the websocket."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.simple.poses_json import POSES, write_poses_json
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.photos.images import load_images
from biresnerf.data.show.view_file import PREVIEW, ViewFile, write_view_file
from biresnerf.data.show.view_pictures import write_contact_sheet, write_points
from biresnerf.data.synthetic.scene import write_synthetic_scene
from tests.commands.poses.test_refine import PROGRAM, command
from tests.data.formats.random_sets import random_result
from tests.service.free_port import free_port

pytest.importorskip("viser")
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.live_view.live_view import LiveView, shown_live
from tests.live_view.client import Browser

POINTS = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 9.0]])
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
NO_POSE_BEFORE = 1  # of `random_result`


@pytest.fixture
def result(tmp_path) -> RefinedSet:
    """A made result, written to ``tmp_path`` / out."""
    refined = random_result(3, model="PINHOLE")
    write_result(tmp_path / "out", refined)
    return refined


def write_result(folder: Path, refined: RefinedSet) -> None:
    write_poses_json(refined, folder / POSES)
    layers = write_points([("field", POINTS, COLOURS)], folder)
    write_view_file(
        ViewFile(poses=POSES, thumbnail="none.jpg", contact_sheet=None, views=(), points=layers, orbit=None),
        folder,
    )


@pytest.fixture
def view(result, tmp_path) -> Iterator[LiveView]:
    with shown_live(LiveView(tmp_path / "out", port=free_port())) as shown:
        yield shown


@pytest.fixture
def browser(view) -> Iterator[Browser]:
    client = Browser(view.url)
    yield client
    client.close()


def pose_of(thing: dict) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(thing["wxyz"], scalar_first=True).as_matrix()
    pose[:3, 3] = thing["position"]
    return pose


def stands_at(browser: Browser, path: str, pose: np.ndarray) -> bool:
    thing = browser.scene.get(path, {})
    return {"wxyz", "position"} <= thing.keys() and np.allclose(pose_of(thing), pose, atol=1e-5)


def test_cameras_and_points_are_where_the_files_have_them(result, browser):
    browser.until(lambda: "position" in browser.scene.get("/before/4", {}) and "/points" in browser.scene)
    for i, image in enumerate(result.images):
        assert stands_at(browser, f"/after/{i}", image.world_from_cam)
        camera = result.cameras[image.camera]
        frustum = browser.scene[f"/after/{i}"]
        assert frustum["fov"] == pytest.approx(2 * np.arctan(camera.height / 2 / camera.full().fy))
        assert frustum["aspect"] == pytest.approx(camera.width / camera.height)
        if i == NO_POSE_BEFORE:
            assert f"/before/{i}" not in browser.scene
        else:
            assert stands_at(browser, f"/before/{i}", image.given)
    cloud = browser.scene["/points"]
    np.testing.assert_allclose(np.frombuffer(cloud["points"], np.float16).reshape(-1, 3), POINTS, atol=1e-2)
    assert np.frombuffer(cloud["colors"], np.uint8).tolist() == COLOURS.ravel().tolist()


def test_cameras_move_while_a_run_shows_itself(result, browser, tmp_path):
    browser.until(lambda: stands_at(browser, "/after/4", result.images[4].world_from_cam))
    moved = result.images[4].world_from_cam.copy()
    moved[:3, 3] += 1.0
    images = (*result.images[:4], replace(result.images[4], world_from_cam=moved))
    write_poses_json(replace(result, images=images), tmp_path / "out" / PREVIEW / POSES)
    browser.until(lambda: stands_at(browser, "/after/4", moved))
    assert stands_at(browser, "/after/3", result.images[3].world_from_cam)
    assert browser.texts[-1] == "5 photos: looking for poses to start from"


def test_given_and_refined_cameras_are_shown_and_hidden_by_their_switches(browser):
    browser.until(lambda: len(browser.switches) == 2)
    browser.switch("given poses", False)
    browser.until(lambda: browser.scene["/before"].get("visible") is False)
    assert browser.scene["/after"].get("visible", True)
    browser.switch("given poses", True)
    browser.until(lambda: browser.scene["/before"]["visible"])


def test_all_cameras_are_before_the_first_look_and_a_click_looks_through_one(result, browser):
    middle = np.median(POINTS, axis=0)
    browser.until(
        lambda: np.allclose(browser.camera.get("LookAt", np.nan), middle) and "/before/4" in browser.scene
    )
    eye, target = browser.camera["Position"], browser.camera["LookAt"]
    towards = (target - eye) / np.linalg.norm(target - eye)
    for image in result.images:
        assert (image.world_from_cam[:3, 3] - eye) @ towards > 0
    browser.camera.clear()
    browser.click("/after/2")
    pose = result.images[2].world_from_cam
    browser.until(lambda: np.allclose(browser.camera.get("Position", np.nan), pose[:3, 3], atol=1e-5))
    forward = browser.camera["LookAt"] - pose[:3, 3]
    np.testing.assert_allclose(forward / np.linalg.norm(forward), pose[:3, 2], atol=1e-5)
    up_in_cam = pose[:3, :3].T @ browser.camera["UpDirection"]  # viser turns it towards what was up before
    assert abs(up_in_cam[0]) < 1e-5
    assert up_in_cam[1] < 0


def photo_at(browser: Browser, path: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(browser.scene[path]["_image_data"])), float)


def test_a_process_that_ends_meanwhile_does_not_keep_the_view_from_starting(result, tmp_path, monkeypatch):
    class Ended:
        def cwd(self) -> str:
            raise psutil.NoSuchProcess(1)

    others = [[Ended()], []]
    monkeypatch.setattr(psutil, "process_iter", lambda: others.pop(0) if others else [])
    LiveView(tmp_path / "out", port=free_port()).stop()


@pytest.mark.parametrize("source", ["input", "contact sheet"])
def test_each_camera_has_its_own_photo(tmp_path, source):
    write_synthetic_scene(tmp_path / "photos", 5, 32, seed=1)
    dataset = read_dataset(tmp_path / "photos")
    images = load_images(dataset, 32, "none")
    refined = random_result(3)
    named = tuple(
        replace(image, name=name, camera=0) for image, name in zip(refined.images, dataset.names, strict=True)
    )
    out = tmp_path / "out"
    write_result(out, replace(refined, images=named, cameras=dataset.cameras[:1]))
    if source == "contact sheet":
        document = json.loads((out / "view.json").read_text())
        document["contact_sheet"] = write_contact_sheet(images, out).model_dump()
        (out / "view.json").write_text(json.dumps(document))
    photos = tmp_path / "photos" if source == "input" else None
    with shown_live(LiveView(out, photos, port=free_port())) as view:
        browser = Browser(view.url)
        browser.until(lambda: "/before/4" in browser.scene)
        browser.close()
    for i in range(5):
        shown = photo_at(browser, f"/after/{i}")
        differences = [np.abs(shown - images.image(k)).mean() for k in range(5)]
        assert np.argmin(differences) == i
        assert differences[i] < 20  # of 255, after JPEG


def test_the_command_serves_the_page_and_ends_quietly_with_ctrl_c(result, tmp_path):
    process = subprocess.Popen(
        [PROGRAM, "view", str(tmp_path / "out"), "--port", str(free_port())],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        url = process.stdout.readline().split()[2]
        page = httpx.get(url)
        assert (page.status_code, "<html" in page.text) == (200, True)
        browser = Browser(url)
        browser.until(lambda: stands_at(browser, "/after/0", result.images[0].world_from_cam))
        browser.close()
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, said[0]) == (0, "")
    assert "Traceback" not in said[1]  # viser's tasks may say that they were still pending


def test_the_command_refuses_a_folder_without_anything_to_see(tmp_path):
    done = subprocess.run([PROGRAM, "view", str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "result_missing" in done.stderr


def test_what_is_seen_needs_no_torch():
    program = "import sys, biresnerf.live_view.live_view; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


@pytest.mark.slow
def test_the_cameras_of_a_refinement_can_be_watched(tmp_path):
    write_synthetic_scene(tmp_path / "scene", 6, 24, seed=1)
    settings = {"start": "none", "verdict": False, "shown_views": 0, "steps": 600}
    words = [*command(tmp_path / "scene", tmp_path / "out", **settings), "--view", "--json"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        url = next(line.split()[2] for line in process.stderr if line.startswith("view at "))
        browser = Browser(url)
        places = set()

        def moved() -> bool:
            places.add(tuple(browser.scene.get("/after/0", {}).get("position", ())))
            return len(places - {()}) > 1

        browser.until(moved, 200)
        assert len(photo_at(browser, "/after/0")) == 24
        browser.close()
        out, _ = process.communicate(timeout=200)
    finally:
        process.kill()
    assert json.loads(out)["state"] == "complete"


class SlowBrowser:
    """A client that has read where to look from, and takes its time until the cameras are drawn."""

    def __init__(self) -> None:
        self.camera = self
        self.looks: list[np.ndarray] = []
        self.asked, self.drawn = threading.Event(), threading.Event()

    @property
    def position(self) -> np.ndarray:
        return self.looks[-1]

    @position.setter
    def position(self, look: np.ndarray) -> None:
        if self.asked.is_set():
            self.drawn.set()
        else:
            self.asked.set()
            self.drawn.wait(1)
        self.looks.append(look)


def test_a_browser_that_connects_while_cameras_are_drawn_keeps_the_new_look(result, tmp_path, monkeypatch):
    view, browser = LiveView(tmp_path / "out", port=free_port()), SlowBrowser()
    try:
        monkeypatch.setattr(view.server, "get_clients", lambda: {0: browser})
        connecting = threading.Thread(target=view._look_at_all, args=(browser,))
        connecting.start()
        assert browser.asked.wait(10)
        assert view.update()
        connecting.join()
        before, after = browser.looks
        assert not np.allclose(before, after)
        np.testing.assert_array_equal(browser.position, view._first_look[0])
    finally:
        view.stop()

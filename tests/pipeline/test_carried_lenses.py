"""Lenses of other formulas through the whole method: photos as such a lens takes them, of a scene with exact truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.synthetic.scene import SHAPES, random_textures, render_shapes, synthetic_cameras
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.pipeline import refine_poses
from tests.pipeline.test_pipeline import OPTIONS

pytestmark = pytest.mark.slow

VIEWS, SIZE, FINE = 24, 64, 3
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Each shows the object as large as the pinhole of the made scene does; what is straight bends by some 3 px.
LENSES = {
    "FOV": {"fl_x": 80.0, "omega": 1.2},
    "EUCM": {"fl_x": 88.0, "alpha": 0.65, "beta": 1.1},
}


def slopes(model: str, xy: np.ndarray) -> np.ndarray:
    """X / Z and Y / Z [..., 2] of pixels, by the published inverses of the formulas."""
    lens = LENSES[model]
    at = (xy - SIZE / 2) / lens["fl_x"]
    r = np.linalg.norm(at, axis=-1, keepdims=True)
    if model == "FOV":
        return at / r * np.tan(r * lens["omega"]) / (2 * np.tan(lens["omega"] / 2))
    alpha, beta = lens["alpha"], lens["beta"]
    z = (1 - beta * alpha**2 * r**2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * beta * r**2) + 1 - alpha)
    return at / z


def photo(model: str, view: np.ndarray) -> np.ndarray:
    """A view [SIZE, SIZE, 4] through the lens, from a large pinhole view [side, side, 4] of focal length `side`."""
    side = len(view)
    grid = (np.arange(SIZE * FINE) + 0.5) / FINE
    at = slopes(model, np.stack(np.meshgrid(grid, grid), -1)) * side + side / 2
    column, row = np.floor(at).astype(int).clip(0, side - 1).transpose(2, 0, 1)
    rays = view[row, column].astype(float)
    rays[..., :3] *= rays[..., 3:] / 255
    mean = rays.reshape(SIZE, FINE, SIZE, FINE, 4).mean((1, 3))
    mean[..., :3] *= 255 / mean[..., 3:].clip(1e-6)
    return np.rint(mean).astype(np.uint8)


@pytest.fixture(scope="module")
def pinhole_views() -> list[np.ndarray]:
    side, textures = 320, random_textures(len(SHAPES), 1)
    return [
        render_shapes(SHAPES, textures, pose, side, side, float(side))[0]
        for pose in synthetic_cameras(VIEWS, seed=1)
    ]


@pytest.fixture(scope="module", params=LENSES)
def scene(request, tmp_path_factory, pinhole_views):
    """The model, the set's folder with noisy poses, and the true ones."""
    model, folder = request.param, tmp_path_factory.mktemp(request.param)
    truth = synthetic_cameras(VIEWS, seed=1)
    (folder / "images").mkdir()
    for index, view in enumerate(pinhole_views):
        Image.fromarray(photo(model, view)).save(folder / "images" / f"{index:02}.png")
    lens = LENSES[model] | {"camera_model": model, "w": SIZE, "h": SIZE, "cx": SIZE / 2, "cy": SIZE / 2}
    start = perturb_poses(truth, 0.1, seed=6) @ OPENGL
    frames = [
        {"file_path": f"images/{index:02}.png", "transform_matrix": pose.tolist()}
        for index, pose in enumerate(start)
    ]
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return model, folder, truth


def test_poses_come_out_as_those_of_a_pinhole_do_and_the_lens_comes_back_to_the_bit(scene, tmp_path):
    model, folder, truth = scene
    given = read_dataset(folder)
    refine_poses(
        folder,
        tmp_path / "out",
        OPTIONS.model_copy(update={"refine_intrinsics": "none", "verdict": False, "orbit_frames": 0}),
    )
    [camera] = read_colmap_model(tmp_path / "out" / "colmap" / "sparse" / "0").cameras.values()
    assert (camera.model, *camera.params) == (model, *given.cameras[0].params)
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert {key: written[key] for key in LENSES[model]} == LENSES[model]
    refined = np.array([frame["transform_matrix"] for frame in written["frames"]]) @ OPENGL
    end = pose_error(refined, truth).aligned
    start = pose_error(given.world_from_cam, truth).aligned
    assert end.rotation_deg.median < 0.25 * start.rotation_deg.median
    assert end.centre_percent.median < 0.33 * start.centre_percent.median

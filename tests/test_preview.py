"""What a running job shows: poses so far and one view, beside every checkpoint."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from biresnerf.config import RefineOptions
from biresnerf.data.read import read_dataset
from biresnerf.data.synthetic import write_synthetic_scene
from biresnerf.errors import Interrupted
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress

OPTIONS = RefineOptions(
    preset="fast", device="cpu", start="given", steps=400, max_image_size=32, samples_per_step=4096,
    pose_resolution_max=24, reconstruction_levels=2, reconstruction_resolution_max=256, table_size_log2=12,
    orbit_frames=0, checkpoint_every_s=0.5,
)  # fmt: skip


def test_a_running_refinement_shows_poses_and_a_view_and_a_finished_one_cleans_up(tmp_path):
    scene = write_synthetic_scene(tmp_path / "scene", 8, 32, seed=3)
    output = tmp_path / "out"
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(scene, output, OPTIONS, told.append, lambda: any(p.checkpoint for p in told))
    so_far = json.loads((output / "preview" / "transforms.json").read_text())
    assert [frame["file_path"] for frame in so_far["frames"]] == list(read_dataset(scene).names)
    np.testing.assert_allclose(np.linalg.det([f["transform_matrix"] for f in so_far["frames"]]), 1, atol=1e-5)
    (render,) = (output / "preview").glob("*_render.png")
    (photo,) = (output / "preview").glob("*_photo.png")
    seen, wanted = (np.asarray(Image.open(p).convert("RGB"), float) / 255 for p in (render, photo))
    assert seen.shape == wanted.shape == (16, 16, 3)
    assert (
        np.abs(seen - wanted).mean() < np.abs(wanted.mean((0, 1)) - wanted).mean()
    )  # closer than one colour
    refine_poses(scene, output, OPTIONS)
    assert not (output / "preview").exists()

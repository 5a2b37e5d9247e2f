"""Photos added to a finished job's result, by the real program of a running service."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from biresnerf.client import Client
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.wire.jobs import JobView
from tests.service.conftest import running_service, short_folder

pytestmark = [pytest.mark.server, pytest.mark.slow]

OLD, ALL = 6, 8
SMALL = {
    "preset": "fast", "device": "cpu", "start": "given", "steps": 60, "coarse_steps_min": 20, "coarse_steps_max": 30,
    "max_image_size": 24, "samples_per_step": 1024, "pose_resolution_max": 24, "reconstruction_levels": 2,
    "table_size_log2": 10, "reconstruction_resolution_max": 256, "orbit_frames": 0, "verdict": False, "threads": 1,
}  # fmt: skip


def first_photos(scene: Path, folder: Path) -> None:
    shutil.copytree(scene, folder)
    document = json.loads((scene / "transforms.json").read_text())
    for frame in document["frames"][OLD:]:
        (folder / f"{frame['file_path']}.png").unlink()
    (folder / "transforms.json").write_text(json.dumps({**document, "frames": document["frames"][:OLD]}))


def poses(client: Client, job: JobView, folder: Path) -> np.ndarray:
    assert job.state == "succeeded", job.error
    client.download_all(job.id, folder)
    return np.array(
        [one["world_from_cam"] for one in json.loads((folder / "poses.json").read_text())["images"]]
    )


def test_photos_join_the_result_of_a_job_whose_poses_stay(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    write_synthetic_scene(scene, ALL, 24, seed=3)
    first_photos(scene, tmp_path / "old")
    program = (sys.executable, "-m", "workers.run.job_process")
    with (
        short_folder() as data,
        running_service(data, job_command=program) as service,
        Client(service.url) as client,
    ):
        first = client.wait(client.submit(tmp_path / "old", SMALL).id)
        earlier = poses(client, first, tmp_path / "first")
        joined = client.wait(client.submit(scene, SMALL, fixed_from=first.id).id)
        assert joined.fixed_from == first.id
        found = poses(client, joined, tmp_path / "joined")
        given = json.loads((scene / "transforms.json").read_text())["frames"]
        assert len(found) == len(given) == ALL
        np.testing.assert_allclose(found[:OLD], earlier, atol=1e-9)
        centres = np.array([frame["transform_matrix"] for frame in given])[:, :3, 3]
        assert np.abs(earlier[:, :3, 3] - centres[:OLD]).max() > 1e-6, "the first job moved them"
        fork = client.wait(client.fork(joined.id, {"warmup_steps": 5}).id)
        np.testing.assert_allclose(poses(client, fork, tmp_path / "fork")[:OLD], earlier, atol=1e-9)

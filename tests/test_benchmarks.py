"""What the benchmarks compare against computes the same thing."""

from __future__ import annotations

import importlib.util
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.gpu import gpu_report
from benchmarks.method import peers
from benchmarks.speed import scene
from benchmarks.speed.clock import timed
from benchmarks.speed.set_step import Operations
from benchmarks.speed.torch_forms import (
    UnrolledField,
    VectorisedField,
    encode_unrolled,
    encode_vectorised,
    march_at_once,
)
from benchmarks.speed.yardstick import build_yardstick, check_yardstick
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import Marching, PositionGradient, Rays
from biresnerf.field.reference import operations as reference
from biresnerf.field.reference.field import ReferenceField
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.studies.scenes import with_poses
from tests.data.scenes import textured_arc
from tests.docs.forms_of_commands import check_shell

pytestmark = pytest.mark.slow

DENSE, HASHED = grid_levels(3, 8, 20, 14), grid_levels(4, 64, 200, 12)


def test_time_within_another_part_counts_once_or_for_both():
    class Parts:
        def outer(self):
            time.sleep(0.01)
            self.inner()

        def inner(self):
            time.sleep(0.02)

    parts = [(Parts, "outer", "outer"), (Parts, "inner", "inner")]
    for outermost in (False, True):
        with timed(parts, time.perf_counter, outermost=outermost) as spent:
            Parts().outer()
            Parts().inner()
        assert spent["outer"] == pytest.approx(0.03, abs=0.015)
        assert (spent["inner"] > 0.035) != outermost


def test_operations_of_torch_are_counted_by_name():
    with Operations() as operations:
        (torch.ones(2) + torch.ones(2)).sum()
    assert operations.count == {"ones": 2, "add": 1, "sum": 1}


@pytest.mark.parametrize("encode", [encode_unrolled, encode_vectorised])
@pytest.mark.parametrize("grid", [DENSE, HASHED])
def test_the_torch_forms_encode_as_the_definition_does(encode, grid):
    generator = torch.Generator().manual_seed(0)
    x, table = torch.rand(333, 3, generator=generator), torch.rand(grid.entries, 2, generator=generator)
    upstream = torch.rand(333, grid.width, generator=generator)
    gradients = []
    for form in (encode, reference.encode):
        points, entries = x.clone().requires_grad_(), table.clone().requires_grad_()
        features = form(points, entries, grid, 0.7)
        features.backward(upstream)
        gradients.append((features.detach(), points.grad, entries.grad))
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs, atol=2e-4 * float(theirs.abs().max()), rtol=0)


def test_the_march_of_all_intervals_at_once_takes_the_definitions_samples():
    generator = torch.Generator().manual_seed(1)
    direction = torch.nn.functional.normalize(torch.randn(100, 3, generator=generator), dim=1)
    origin = (torch.rand(100, 3, generator=generator) - 0.5) - 2.5 * direction
    occupied = (torch.rand(8, 8, 8, generator=generator) < 0.5).to(torch.uint8)
    rays = Rays(origin, direction, torch.ones(100, 3), torch.rand(100, generator=generator), 100)
    t, dt, ray = march_at_once(rays, Marching(0.05, 0.1, 10.0, 256, occupied))
    expected = reference.march(origin, direction, rays.jitter, occupied, 0.05, 0.1, 10.0, False, 256)
    assert abs(len(t) - len(expected[0])) <= 5  # midpoints on cell faces
    count, other = (np.bincount(r.numpy(), minlength=100) for r in (ray, expected[2]))
    same = count == other
    assert same.mean() > 0.95
    assert float(dt.mean()) == pytest.approx(0.05)
    assert float(t.mean()) == pytest.approx(float(expected[0].mean()), abs=1e-2)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
@pytest.mark.parametrize("grid", [DENSE, HASHED])
def test_the_yardstick_in_cpp_computes_what_the_definition_does(grid):
    library = build_yardstick()
    assert library is not None
    check_yardstick(library, grid)
    assert np.float32(1e-45) * 1 > 0, "loading it must not flush subnormal numbers to zero"


@pytest.mark.parametrize("form", [UnrolledField, VectorisedField])
@pytest.mark.parametrize("stage", ["coarse", "fine"])
def test_a_step_of_the_torch_forms_computes_what_the_definitions_step_does(form, stage):
    ours = scene.untrained(images=4, threads=1, size=32, preset="fast")
    gradients = []
    for kind in (form, ReferenceField):
        field = kind(ours.field.shape, 0, scene.CPU)
        if stage == "fine":
            field.start_reconstruction()
        generator = torch.Generator().manual_seed(1)
        direction = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator), dim=1)
        origin = (-2.5 * direction).requires_grad_()
        rays = Rays(origin, direction, torch.ones(64, 3), torch.full((64,), 0.5), 64)
        marching = Marching(0.02, 0.1, 10.0, 256, ours.occupancy.occupied)
        rendering = field.render(rays, marching, PositionGradient(0.7, 0.7, 0.5))
        assert rendering.samples > 100
        (rendering.colour.square().sum()).backward()
        gradients.append((rendering.colour.detach(), field.pose_table.grad, origin.grad))
    for mine, theirs in zip(*gradients, strict=True):
        # Not entry by entry: samples whose midpoint lies on a cell's face are taken by one form and not the other.
        assert float((mine - theirs).norm() / theirs.norm()) < 0.02


def test_colmap_on_a_rendered_arc_is_measured_against_its_truth(tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
    poses = textured_arc(tmp_path, 10, 300)
    camera = Camera("SIMPLE_PINHOLE", 300, 300, (synthetic_focal(300), 150, 150))
    photos = sorted(tmp_path.iterdir())
    frames = tuple(Frame(p.name, p, 0, pose, "given") for p, pose in zip(photos, poses, strict=True))
    truth = Dataset(tmp_path, (camera,), frames, SourceFormat("nerfstudio", None, {}, np.eye(4)))
    lines = list(peers.measured("arc", truth, with_poses(truth, perturb_poses(poses, 0.1, seed=2)), seed=1))
    assert [line["peer"] for line in lines] == list(peers.PEERS)
    for line in lines:
        assert line["placed"] == 10
        assert line["rotation_deg"] <= line["worst_deg"] < 2  # of 12 with the noise
        assert line["centre_percent"] < 2
    assert lines[0]["rotation_deg"] != lines[1]["rotation_deg"], "priors have a say"
    assert len(peers.table(lines).splitlines()) == 3


def test_a_gpu_report_holds_what_each_command_printed_and_how_it_ended(tmp_path, monkeypatch):
    works, fails = (sys.executable, "-c", "print(6 * 7)"), (sys.executable, "-c", "raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gpu_report, "commands", lambda _work: [works, fails, ("no-such-program",)])
    gpu_report.main()
    parts = (tmp_path / "gpu-report.txt").read_text().split("$ ")[1:]
    for part, expected in zip(
        parts, ("42\n\nexit status 0", "exit status 3", "exit status not there"), strict=True
    ):
        assert expected in part


def test_the_commands_of_a_gpu_report_are_there(tmp_path):
    for command in gpu_report.commands(tmp_path):
        words = list(command)
        if words[0] == sys.executable:
            assert importlib.util.find_spec(words[2]) is not None
        elif words[0] != "nvidia-smi":
            assert Path(words[0]).is_file()
            check_shell(" ".join(["biresnerf", *words[1:]]))
        for path in (word for word in words if word.startswith("tests/")):
            assert (Path(__file__).parents[1] / path).exists()

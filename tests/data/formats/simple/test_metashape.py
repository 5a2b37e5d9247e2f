"""Metashape: lenses project as its manual says; labels, states and components of cameras are kept apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from biresnerf.data.formats.parsed_poses import without_problems
from biresnerf.data.formats.photogrammetry.metashape import parse_metashape
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera import Intrinsics, project
from tests.data.formats.random_sets import random_poses
from tests.data.formats.simple.trajectories import metashape_xml

WIDTH, HEIGHT = 20, 16
IDENTITY = " ".join(map(str, np.eye(4).ravel()))


def parsed(folder: Path, **parts: str):
    file = folder / "cameras.xml"
    file.write_text(metashape_xml(**parts))
    return without_problems(parse_metashape(folder, file))


def by_the_manual(
    points: np.ndarray, k: tuple[float, float, float], p: tuple[float, float], b: tuple[float, float]
):
    """Pixels of points in the camera's frame: Metashape Professional 2 manual, appendix on camera models."""
    f, cx, cy = 18.5, 0.25, -0.25
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x**2 + y**2
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    x_lens = x * radial + p[0] * (r2 + 2 * x**2) + 2 * p[1] * x * y
    y_lens = y * radial + p[1] * (r2 + 2 * y**2) + 2 * p[0] * x * y
    return np.stack(
        [WIDTH / 2 + cx + x_lens * (f + b[0]) + y_lens * b[1], HEIGHT / 2 + cy + y_lens * f], axis=1
    )


@pytest.mark.parametrize(
    ("k", "p", "b"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        ((0.05, -0.01, 0.0), (0.003, -0.002), (0.0, 0.0)),
        ((0.05, -0.01, 0.002), (0.003, -0.002), (0.4, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0), (0.0, 1.5)),
        ((0.05, -0.01, 0.002), (0.003, -0.002), (0.4, -1.5)),
    ],
    ids=["pinhole", "radial and tangential", "all terms and an aspect", "skew", "all terms, aspect and skew"],
)
def test_the_lens_projects_as_the_manual_says(tmp_path, k, p, b):
    terms = {"k1": k[0], "k2": k[1], "k3": k[2], "p1": p[0], "p2": p[1], "b1": b[0], "b2": b[1]}
    lens = "".join(f"<{name}>{value}</{name}>" for name, value in terms.items())
    camera = parsed(tmp_path, lens=lens).entries[0].lens
    points = np.random.default_rng(0).uniform((-0.4, -0.3, 1), (0.4, 0.3, 3), (50, 3))
    index = torch.zeros(len(points), dtype=torch.long)
    found = project(Intrinsics.from_cameras([camera]), index, torch.tensor(points))
    stored = found.numpy()
    stored[:, 0] += camera.shear * (stored[:, 1] - HEIGHT / 2)
    np.testing.assert_allclose(stored, by_the_manual(points, k, p, b), atol=1e-4)


@pytest.mark.parametrize("term", ["k4", "p3", "p4"])
def test_a_term_that_no_supported_model_has_is_refused_and_named(tmp_path, term):
    with pytest.raises(InputError, match=term) as refused:
        parsed(tmp_path, lens=f"<{term}>0.01</{term}>")
    assert refused.value.code == "camera_model_unsupported"


def camera(number: int, inside: str, more: str = "") -> str:
    return f'<camera id="{number}" sensor_id="0" label="{number}.png" {more}>{inside}</camera>'


def test_cameras_not_aligned_have_no_pose_and_those_switched_off_are_left_out(tmp_path):
    placed = f"<transform>{IDENTITY}</transform>"
    cameras = camera(1, placed) + camera(2, "") + camera(3, placed, 'enabled="false"')
    entries = {entry.name: entry.world_from_cam for entry in parsed(tmp_path, cameras=cameras).entries}
    assert set(entries) == {"1.png", "2.png"}
    np.testing.assert_array_equal(entries["1.png"], np.eye(4))
    assert entries["2.png"] is None


def test_the_largest_component_alone_has_poses(tmp_path):
    placed = f"<transform>{IDENTITY}</transform>"
    cameras = "".join(camera(n, placed, f'component_id="{int(n == 3)}"') for n in range(4))
    result = parsed(tmp_path, cameras=cameras)
    assert [entry.name for entry in result.entries if entry.world_from_cam is None] == ["3.png"]
    assert any("3.png" in note for note in result.notes)


def test_the_cameras_of_a_rig_have_their_masters_pose_moved_by_their_sensor(tmp_path):
    masters = random_poses(np.random.default_rng(3), 3)
    master_from_slave = random_poses(np.random.default_rng(4), 1)[0]
    placed = [f"<transform>{' '.join(map(repr, pose.ravel().tolist()))}</transform>" for pose in masters]
    cameras = "".join(camera(n, text) for n, text in enumerate(placed)) + camera(3, "")
    cameras += "".join(
        camera(10 + n, "", f'master_id="{n}"').replace('sensor_id="0"', 'sensor_id="1"') for n in range(4)
    )
    place = "".join(
        f"<{name}>{' '.join(map(repr, values.ravel().tolist()))}</{name}>"
        for name, values in (("rotation", master_from_slave[:3, :3]), ("location", master_from_slave[:3, 3]))
    )
    one, end = "<sensor id=", "</sensors>"
    export = metashape_xml(cameras=cameras)
    sensor = export[export.index(one) : export.index(end)]
    slave = sensor.replace('id="0"', 'id="1" master_id="0"').replace("</sensor>", f"{place}</sensor>")
    (tmp_path / "cameras.xml").write_text(export.replace(end, slave + end))
    entries = {entry.name: entry for entry in parse_metashape(tmp_path, tmp_path / "cameras.xml").entries}
    for n, pose in enumerate(masters):
        np.testing.assert_allclose(entries[f"{n}.png"].world_from_cam, pose, atol=1e-12)
        found = entries[f"{10 + n}.png"].world_from_cam
        np.testing.assert_allclose(found, pose @ master_from_slave, atol=1e-12)
    assert entries["13.png"].world_from_cam is None  # its master has none


def test_an_entity_is_refused_before_it_expands(tmp_path):
    file = tmp_path / "cameras.xml"
    file.write_text('<!DOCTYPE x [<!ENTITY a "aaaa">]>' + metashape_xml().partition("?>")[2])
    with pytest.raises(InputError) as refused:
        parse_metashape(tmp_path, file)
    assert refused.value.code == "pose_file_invalid"


@pytest.mark.parametrize(("b2", "moves"), [(1.0, False), (1.2, True)])
def test_a_skew_is_left_out_up_to_half_a_pixel_at_the_edge(tmp_path, b2, moves):
    """b2 moves a pixel by b2 * y / f: 8 px above the centre, at a focal length of 18.5 px, by 0.43 of b2."""
    found = parsed(tmp_path, lens=f"<b2>{b2}</b2>").entries[0].lens
    assert (found.shear != 0) is moves


def test_a_skew_that_no_lens_has_is_refused(tmp_path):
    with pytest.raises(InputError, match="skew of 2 px") as refused:
        parsed(tmp_path, lens="<b2>2</b2>")
    assert refused.value.code == "intrinsics_invalid"

"""Control points as OpenDroneMap and tables list them, and how far cameras see them from where they were measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.client.scene import look_at
from biresnerf.data.formats.positions.control_points import control_points
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.points.located_points import metres_from_world
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import InputError
from biresnerf.write.georeference import control_report

OFFSET = np.array([611_000.0, 5_277_000.0, 460.0])
METRES_PER_UNIT = 5.0
POINTS = np.array([[0.4, 0.3, 0.1], [-0.5, 0.2, 0], [0.1, -0.5, 0.2], [-0.2, -0.1, 0.4], [0.5, -0.4, -0.1]])


@pytest.fixture(name="scene")
def made_scene(tmp_path: Path):
    """A set with true poses in a unit of 5 m, and the observations of five points in all its photos."""
    dataset = read_dataset(write_synthetic_scene(tmp_path / "set", 6, 24, seed=3))
    lens = dataset.camera_of(0).full()
    marks = {}
    for frame in dataset.frames:
        in_cam = (POINTS - frame.world_from_cam[:3, 3]) @ frame.world_from_cam[:3, :3]
        marks[Path(frame.name).name] = in_cam[:, :2] / in_cam[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    return dataset, marks


def odm(marks, header="WGS84 UTM 33N", coordinates=POINTS * METRES_PER_UNIT + OFFSET):
    """As OpenDroneMap's own sets have them: photos named in another case, tabs, names of points at the end."""
    rows = [
        "\t".join([*(f"{c:.8f}" for c in coordinates[i]), *(f"{v:.4f}" for v in xy[i]), photo.upper(), name])
        for photo, xy in marks.items()
        for i, name in enumerate(["gcp1", "gcp2", "gcp3", "gcp4", "CHK-1"])
    ]
    return "\n".join([header, *rows, ""])


def test_a_gcp_list_gives_the_frame_and_says_how_far_each_point_is_off(scene):
    dataset, marks = scene
    coordinates = POINTS * METRES_PER_UNIT + OFFSET
    coordinates[4] += [0.0, 0.0, 0.03]  # the check point was measured 3 cm too high
    (dataset.root / "gcp_list.txt").write_text(odm(marks, coordinates=coordinates))
    points = control_points(dataset)
    assert points.names == ("gcp1", "gcp2", "gcp3", "gcp4", "CHK-1")
    assert points.check.tolist() == [False] * 4 + [True]
    assert points.epsg == 32633
    dataset = replace(dataset, control=points)
    frame = metres_from_world(dataset, dataset.world_from_cam)
    assert frame.scale == pytest.approx(METRES_PER_UNIT, rel=1e-4)
    np.testing.assert_allclose(frame.translation, OFFSET, atol=2e-3)
    report = control_report(dataset, dataset.world_from_cam)
    assert report.control_m < 1e-3
    assert report.control_px < 1e-3
    assert report.check_m == pytest.approx(0.03, abs=2e-3)
    assert report.points[4].error_m[2] == pytest.approx(-0.03, abs=2e-3)
    assert [point.images for point in report.points] == [6] * 5


def test_degrees_become_metres_east_north_and_up(scene):
    dataset, marks = scene
    degrees = np.column_stack([16.476 + POINTS[:, 0] / 75_000, 47.643 + POINTS[:, 1] / 111_170, POINTS[:, 2]])
    (dataset.root / "gcp_list.txt").write_text(odm(marks, "EPSG:4326", degrees))
    points = control_points(dataset)
    assert points.origin == pytest.approx((47.643, 16.476, 0.1), abs=1e-4)
    apart = points.metres - points.metres[0]
    np.testing.assert_allclose(apart, POINTS - POINTS[0], atol=5e-3)


def test_a_csv_has_accuracies_and_check_points_and_points_that_few_photos_show_are_left_out(scene):
    dataset, marks = scene
    rows = ["# EPSG:25833", "Name;X;Y;Z;Accuracy;Accuracy Z;Check;Image;px;py"]
    for photo, xy in list(marks.items())[:3]:
        for i, place in enumerate(POINTS):
            if i or photo == next(iter(marks)):
                rows.append(
                    ";".join(map(str, [f"p{i}", *place, 0.02, 0.05, "yes" if i == 3 else "", photo, *xy[i]]))
                )
    (dataset.root / "gcp.csv").write_text("\n".join(rows))
    points = control_points(dataset)
    assert points.names == ("p1", "p2", "p3", "p4")
    assert points.check.tolist() == [False, False, True, False]
    assert points.accuracy_m[0].tolist() == [0.02, 0.02, 0.05]
    assert points.epsg == 25833
    assert "gcp.csv" in [name for name, _ in look_at(dataset.root)]
    (note,) = [note for note in read_dataset(dataset.root).warnings if "gcp.csv" in note]
    assert "3 control points and 1 check points in 3 photos" in note


def test_too_few_control_points_claim_no_frame(scene):
    dataset, marks = scene
    two = [line for line in odm(marks).splitlines() if "gcp3" not in line and "gcp4" not in line]
    (dataset.root / "gcp_list.txt").write_text("\n".join(two))
    dataset = replace(dataset, control=control_points(dataset))
    assert metres_from_world(dataset, dataset.world_from_cam) is None
    assert "3 are needed" in control_report(dataset, dataset.world_from_cam).why_not


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("EPSG:32633\n1 2 3 4 5\n", "gcp_list.txt line 2"),
        ("EPSG:32633\n1 2 3 4 five a.jpg\n", "gcp_list.txt line 2"),
        ("nothing\n1 2 3 4 5 a.jpg\n", "gcp_list.txt line 1"),
        ("EPSG:32633\n1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "gcp_list.txt line 3"),
    ],
)
def test_a_line_that_cannot_be_read_is_named(scene, text, where):
    (scene[0].root / "gcp_list.txt").write_text(text)
    with pytest.raises(InputError) as caught:
        control_points(scene[0])
    assert caught.value.where == where
    assert caught.value.hint

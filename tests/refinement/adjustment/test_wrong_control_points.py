"""Control points that are wrong are named, and never make poses worse that are then called improved."""

from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.model.measured_places import ControlPoints
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence
from biresnerf.refinement.adjustment.measured_terms import control_believed
from biresnerf.refinement.finish.gather_evidence import measured_evidence
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.refinement.verdict.judgement import _by_positions
from biresnerf.refinement.views.compare_rigs import Rig
from biresnerf.write.georeference import control_report
from tests.refinement.adjustment.test_measured_terms import (
    COUNT,
    FREE,
    GUESS,
    HEIGHT,
    METRES_FROM_WORLD,
    WIDTH,
    adjusted,
    errors_m,
    flight,
    observed_from,
)

POINTS, CHECKS = 6, 4
PINHOLE = Camera("PINHOLE", WIDTH, HEIGHT, (1000.0, 1000.0, 600.0, 450.0))
ALL = np.ones(COUNT, dtype=bool)


def marked_points(truth, rng, relief_m) -> ControlPoints:
    """Six control points and four check points on the land, in UTM, each to 0.02 m."""
    count = POINTS + CHECKS
    land = np.column_stack(
        [rng.uniform(-20, 145, count), rng.uniform(-20, 120, count), rng.normal(0, relief_m, count)]
    )
    land += METRES_FROM_WORLD.translation
    seen = observed_from(METRES_FROM_WORLD.apply_to_poses(truth), land, rng)
    return ControlPoints(
        "gcp.csv", tuple(f"p{i}" for i in range(count)), land + rng.normal(0, 0.02, land.shape),
        np.full((count, 3), 0.02), np.arange(count) >= POINTS, seen.point, seen.image, seen.xy, None, 32633,
    )  # fmt: skip


def with_control(points, camera=PINHOLE) -> Dataset:
    frames = tuple(Frame(f"{i}.jpg", Path(f"{i}.jpg"), 0, None, "colmap") for i in range(COUNT))
    return Dataset(Path(), (camera,), frames, SourceFormat("images"), control=points)


def one_off(metres):
    metres[2] += [5.0, 0, 0]
    return metres


def swapped(metres):
    return metres[:, [1, 0, 2]]


def raised(metres):
    return metres + np.array([0, 0, 40.0])


@pytest.fixture(scope="module")
def made():
    """By seed and relief: the truth, the points, tracks, and the poses and lens that these alone give."""
    found = {}

    def of(seed, relief_m):
        if (seed, relief_m) not in found:
            rng = np.random.default_rng(seed)
            truth, tracks = flight(rng)
            tracks = tracks.where(tracks.point < 60)
            points = marked_points(truth, rng, relief_m)
            found[seed, relief_m] = truth, points, tracks, adjusted(truth, tracks)
        return found[seed, relief_m]

    return of


def rig(found) -> Rig:
    focal, k1, k2 = found.lenses.correction[0, :3]
    camera = Camera("RADIAL", WIDTH, HEIGHT, (1000.0 * np.exp(focal), 600.0, 450.0, k1, k2))
    return Rig(found.world_from_cam, (camera,) * COUNT)


def judged(made, seed, relief_m, wrong):
    """The points, the poses of tracks alone, those that a run goes on with, and what the verdict says of these."""
    truth, points, tracks, alone = made(seed, relief_m)
    points = ControlPoints(**{**vars(points), "metres": wrong(points.metres.copy())})
    control = measured_evidence(with_control(points), alone.world_from_cam, ALL, EvidenceNumbers()).control
    found = adjusted(alone.world_from_cam, tracks, control=control)
    lenses = FREE.known(found.lenses.correction)
    if not control_believed(Evidence(GUESS, control=control), Cameras.of(found.world_from_cam, lenses)):
        found = adjusted(alone.world_from_cam, tracks)
    before, after = rig(alone), rig(found)
    sets = (with_control(points, each.cameras[0]) for each in (before, after))
    old, new = sets
    favoured = _by_positions(old, before, after, new, ALL, EvidenceNumbers())
    report = control_report(new, found.world_from_cam)
    return truth, alone, found, favoured, report


@pytest.mark.parametrize("seed", [1, 2])
def test_a_point_that_is_off_is_named_with_its_distance_and_does_no_harm(made, seed):
    truth, alone, found, _, report = judged(made, seed, 3.0, one_off)
    assert [point.name for point in report.points if point.far_off] == ["p2"]
    assert "p2 by 4." in report.doubt or "p2 by 5." in report.doubt
    assert errors_m(found.world_from_cam, truth) < errors_m(alone.world_from_cam, truth) + 0.02
    assert report.check_m < 0.5


@pytest.mark.parametrize("relief_m", [0.3, 3.0, 15.0], ids=["flat", "hilly", "steep"])
@pytest.mark.parametrize("seed", [1, 2])
def test_swapped_coordinates_are_not_believed(made, seed, relief_m):
    truth, alone, found, favoured, report = judged(made, seed, relief_m, swapped)
    assert errors_m(found.world_from_cam, truth) < errors_m(alone.world_from_cam, truth) + 0.02
    assert favoured != "better"
    assert "swapped" in report.doubt


@pytest.mark.parametrize("seed", [1, 2])
def test_another_height_datum_moves_the_frame_alone(made, seed):
    truth, _, right, _, report = judged(made, seed, 3.0, lambda metres: metres)
    _, _, found, _, raised_report = judged(made, seed, 3.0, raised)
    assert report.doubt is None
    assert raised_report.doubt is None
    assert errors_m(found.world_from_cam, truth) == pytest.approx(
        errors_m(right.world_from_cam, truth), abs=1e-3
    )
    assert raised_report.metres_from_world[2][3] - report.metres_from_world[2][3] == pytest.approx(
        40, abs=0.01
    )

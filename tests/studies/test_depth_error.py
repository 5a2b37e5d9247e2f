"""The true depth of made scenes, and the error of depth rendered from fields of known surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.synthetic.captures import write_vase, write_walk
from biresnerf.data.synthetic.scene import SHAPES, write_synthetic_scene
from biresnerf.studies.depth_error import depth_error, is_made, true_distance
from tests.data.synthetic.test_scene import signed_distance
from tests.refinement.analytic_field import AnalyticField
from tests.refinement.tiny_scene import given_scene, tiny_optimiser, tiny_options, tiny_set

SIZE = 32


def in_world(pose: np.ndarray, distance: np.ndarray, focal: float) -> np.ndarray:
    height, width = distance.shape
    y, x = np.nonzero(np.isfinite(distance))
    ray = np.stack([(x + 0.5 - width / 2) / focal, (y + 0.5 - height / 2) / focal, np.ones(len(x))], 1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return distance[y, x, None] * ray @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize("write", [write_synthetic_scene, write_vase, write_walk])
def test_views_agree_on_where_the_surfaces_are(tmp_path, write):
    """A point of one view lies no nearer than the surface that another sees there, and mostly on it."""
    dataset = read_dataset(write(tmp_path, 30, SIZE, 1))
    assert is_made(dataset)
    camera = dataset.cameras[0]
    width, height, focal = camera.width, camera.height, camera.full().fx
    here, *others = dataset.world_from_cam
    there = sorted(others, key=lambda pose: np.linalg.norm(pose - here))[2]
    points = in_world(here, true_distance(dataset, here, width, height, focal), focal)
    in_cam = (points - there[:3, 3]) @ there[:3, :3]
    u = in_cam[:, :2] / in_cam[:, 2:] * focal + [width / 2, height / 2]
    seen = (in_cam[:, 2] > 0) & (u >= 0).all(1) & (u[:, 0] < width) & (u[:, 1] < height)
    column, row = np.floor(u[seen]).astype(int).T
    surface = true_distance(dataset, there, width, height, focal)[row, column]
    ratio = np.linalg.norm(in_cam[seen], axis=1) / surface
    assert seen.sum() > 100
    assert (ratio > 0.95).mean() > 0.85  # pixels at outlines see past it
    assert (np.abs(ratio - 1) < 0.05).mean() > 0.7


def test_other_sets_are_not_made(tmp_path):
    path = write_synthetic_scene(tmp_path, 3, 16, 1)
    path.write_text(path.read_text().replace("made_scene", "my_scene"))
    assert not is_made(read_dataset(path))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    dataset, images = tiny_set(tmp_path_factory.mktemp("scene"), size=SIZE)
    return dataset, images, tiny_optimiser(dataset, images, tiny_options(), held_out=[3])


def surfaces(made, fog: float = 0.0) -> AnalyticField:
    """The shapes themselves, opaque, in fog of so much density per unit length."""
    world_from_unit = made[2].frame.unit_from_world.inverse()

    def formula(points: torch.Tensor) -> torch.Tensor:
        world = world_from_unit.apply(points.numpy().astype(np.float64))
        inside = np.min([signed_distance(shape, world) for shape in SHAPES], axis=0) < 0
        return torch.from_numpy(np.where(inside, 1e4, fog)).float()

    return AnalyticField(formula, unbounded=False)


def test_the_true_surfaces_have_next_to_no_error_and_fog_has(made):
    dataset, images, optimiser = made
    scene, truth = given_scene(dataset, images, held_out=[3]), dataset.world_from_cam
    optimiser.field = surfaces(made)
    exact = depth_error(scene, optimiser.renderer, truth)
    optimiser.field = surfaces(made, fog=1.0)
    assert exact < 0.02  # an interval of marching, and pixels at outlines
    assert depth_error(scene, optimiser.renderer, truth) > 0.1


def test_an_empty_field_is_wholly_wrong(made):
    dataset, images, optimiser = made
    scene = given_scene(dataset, images, held_out=[3])
    optimiser.field = AnalyticField(lambda points: torch.zeros(len(points)), unbounded=False)
    assert (
        depth_error(scene, optimiser.renderer, dataset.world_from_cam) == 1.0
    )  # nothing is rendered: as far off as can be


def test_there_is_none_without_held_out_views(made):
    dataset, images, optimiser = made
    assert depth_error(given_scene(dataset, images), optimiser.renderer, dataset.world_from_cam) is None

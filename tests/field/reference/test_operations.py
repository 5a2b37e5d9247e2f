"""The definition of the field against values computed by hand, other libraries and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.reference import operations as reference
from biresnerf.field.spherical_harmonics import spherical_harmonics

pytestmark = pytest.mark.slow

DOUBLE = torch.float64


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def inner_points(count: int, grid, seed: int = 0) -> torch.Tensor:
    """Points in [0, 1] at least 2 % of a cell away from every face of every level."""
    points = random(20 * count, 3, seed=seed)
    position = points[:, :, None] * torch.from_numpy(grid.scale.astype(np.float64)) + 0.5
    fraction = position - position.floor()
    return points[((fraction > 0.02) & (fraction < 0.98)).all(-1).all(-1)][:count].contiguous()


def test_a_dense_level_is_trilinear_interpolation_between_vertices_half_a_cell_off():
    grid = grid_levels(1, 5, 5, 12)  # scale 4: vertex i lies at x = (i - 0.5) / 4
    table = random(grid.entries, 2)
    stride = int(grid.stride[0])
    assert stride == 6
    points = random(50, 3, seed=1)
    features = reference.encode(points, table, grid)
    for point, feature in zip(points.tolist(), features, strict=True):
        expected = torch.zeros(2, dtype=DOUBLE)
        for i in range(stride):
            for j in range(stride):
                for k in range(stride):
                    tents = [
                        max(0.0, 1 - abs(4 * c + 0.5 - v)) for c, v in zip(point, (i, j, k), strict=True)
                    ]
                    expected += math.prod(tents) * table[i + stride * (j + stride * k)]
        torch.testing.assert_close(feature, expected)


def test_a_point_on_a_vertex_gets_that_vertexs_entry():
    grid = grid_levels(1, 5, 5, 12)
    table = random(grid.entries, 2)
    point = torch.tensor([[(2 - 0.5) / 4, (3 - 0.5) / 4, (1 - 0.5) / 4]], dtype=DOUBLE)
    torch.testing.assert_close(reference.encode(point, table, grid)[0], table[2 + 6 * (3 + 6 * 1)])


def test_a_hashed_level_takes_vertices_where_tiny_cuda_nns_hash_puts_them():
    grid = grid_levels(1, 101, 101, 10)  # scale 100, 1024 entries
    assert grid.hashed[0]
    table = random(grid.entries, 2)
    x, y, z = 7, 60, 33
    # 60 * 2654435761 = 37 * 2^32 + 352355708 and 33 * 805459861 = 6 * 2^32 + 810371637; the last ten bits of
    # 7, 0b0001111100 and 0b1000110101 differ in 0b1101001110.
    index = 846
    assert index == (7 ^ 352355708 ^ 810371637) % 1024
    point = torch.tensor([[(v - 0.5) / 100 for v in (x, y, z)]], dtype=DOUBLE)
    torch.testing.assert_close(reference.encode(point, table, grid)[0], table[index])


def test_levels_lie_one_after_another_in_table_and_features():
    grid = grid_levels(3, 4, 40, 10)
    table = random(grid.entries, 2)
    points = random(20, 3, seed=2)
    whole = reference.encode(points, table, grid)
    for level in range(3):
        alone = table.clone()
        alone[: grid.offset[level]] = 0
        alone[grid.offset[level + 1] :] = 0
        part = reference.encode(points, alone, grid)
        torch.testing.assert_close(part[:, 2 * level : 2 * level + 2], whole[:, 2 * level : 2 * level + 2])
        assert float(part.abs().sum()) == pytest.approx(float(part[:, 2 * level : 2 * level + 2].abs().sum()))


@given(w=st.floats(0, 1), smoothing=st.floats(0, 1))
def test_straight_through_is_the_fraction_with_a_smoothed_gradient(w, smoothing):
    fraction = torch.tensor(w, dtype=DOUBLE, requires_grad=True)
    value = reference.straight_through_fraction(fraction, smoothing)
    value.backward()
    assert float(value.detach()) == pytest.approx(w, abs=1e-15)
    assert float(fraction.grad) == pytest.approx(
        1 + smoothing * math.pi / 2 * math.sin(math.pi * w), abs=1e-12
    )


def test_smoothing_changes_neither_features_nor_the_gradient_to_the_table():
    grid = grid_levels(2, 5, 9, 12)
    points = inner_points(30, grid)
    results = []
    for smoothing in (0.0, 1.0):
        table = random(grid.entries, 2).requires_grad_()
        x = points.clone().requires_grad_()
        features = reference.encode(x, table, grid, smoothing)
        (features**2).sum().backward()
        results.append((features.detach(), table.grad, x.grad))
    torch.testing.assert_close(results[0][0], results[1][0])
    torch.testing.assert_close(results[0][1], results[1][1])
    assert not torch.allclose(results[0][2], results[1][2])


def test_the_smoothed_gradient_along_an_axis_is_the_linear_one_times_the_factor_of_that_axis():
    grid = grid_levels(1, 5, 5, 12)
    table = random(grid.entries, 2)
    points = inner_points(30, grid)

    def gradient(smoothing: float) -> torch.Tensor:
        x = points.clone().requires_grad_()
        reference.encode(x, table, grid, smoothing)[:, 0].sum().backward()
        return x.grad

    fraction = (points * 4 + 0.5) % 1
    torch.testing.assert_close(
        gradient(1.0), gradient(0.0) * (1 + math.pi / 2 * torch.sin(math.pi * fraction))
    )


@pytest.mark.parametrize("table_size_log2", [6, 10])  # hashed and dense
def test_gradients_of_the_encoding_equal_finite_differences(table_size_log2):
    grid = grid_levels(2, 3, 5, table_size_log2)
    table = random(grid.entries, 2).requires_grad_()
    x = inner_points(4, grid).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, table: reference.encode(x, table, grid), (x, table), atol=1e-6)


def network_weights(width: int) -> list[torch.Tensor]:
    shapes = [(64, width), (16, 64), (64, 32), (64, 64), (3, 64)]
    return [((random(*shape, seed=7 + i) - 0.5) * 0.5).requires_grad_() for i, shape in enumerate(shapes)]


def test_the_network_is_two_perceptrons_written_out():
    features, view, weights = random(5, 6), random(5, 16, seed=1), network_weights(6)
    density, colour = reference.network(features, view, weights)
    w1, w2, w3, w4, w5 = (w.detach().numpy() for w in weights)
    for i in range(5):
        outputs = w2 @ np.maximum(w1 @ features[i].numpy(), 0)
        hidden = np.maximum(w3 @ np.concatenate([view[i].numpy(), outputs]), 0)
        logits = w5 @ np.maximum(w4 @ hidden, 0)
        assert float(density[i].detach()) == pytest.approx(math.exp(outputs[0] - 1))
        np.testing.assert_allclose(colour[i].detach().numpy(), 1 / (1 + np.exp(-logits)))


def test_gradients_of_the_network_equal_finite_differences():
    inputs = (random(3, 6).requires_grad_(), random(3, 16, seed=1).requires_grad_(), *network_weights(6))
    assert torch.autograd.gradcheck(lambda f, v, *w: reference.network(f, v, list(w)), inputs, fast_mode=True)


def test_density_never_overflows():
    logits = torch.tensor([-1e30, 0.0, 1.0, 12.0, 1e30], dtype=torch.float32)
    np.testing.assert_allclose(
        reference.density_of(logits), [0, math.exp(-1), 1, math.exp(11), math.exp(11)], rtol=1e-6
    )


def test_harmonics_are_scipys_real_ones_up_to_sign_and_order():
    directions = torch.nn.functional.normalize(random(40, 3) - 0.5, dim=1)
    x, y, z = directions.T.numpy()
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            values = sph_harm_y(degree, abs(order), polar, azimuth)
            part = values.real if order >= 0 else values.imag
            expected.append(part * (math.sqrt(2) if order else 1))
    ours = spherical_harmonics(directions).numpy()
    for column, values in enumerate(expected):
        sign = np.sign(ours[0, column] * values[0])
        np.testing.assert_allclose(ours[:, column], sign * values, atol=1e-12)


def samples():
    """Three rays with 3, 0 and 2 samples."""
    ray = torch.tensor([0, 0, 0, 2, 2])
    t = torch.tensor([1.0, 1.5, 2.5, 0.7, 3.0], dtype=DOUBLE)
    dt = torch.tensor([0.5, 0.5, 1.0, 0.2, 0.4], dtype=DOUBLE)
    return 3 * random(5), random(5, 3, seed=1), t, dt, ray, random(3, 3, seed=2)


def test_compositing_is_light_passed_on_from_sample_to_sample():
    density, colour, t, dt, ray, background = samples()
    rgb, opacity, depth = reference.composite(density, colour, t, dt, ray, background)
    for r in range(3):
        passed, seen, far = 1.0, np.zeros(3), 0.0
        for k in [k for k in range(5) if ray[k] == r]:
            absorbed = 1 - math.exp(-float(density[k] * dt[k]))
            seen = seen + passed * absorbed * colour[k].numpy()
            far += passed * absorbed * float(t[k])
            passed *= 1 - absorbed
        np.testing.assert_allclose(rgb[r], seen + passed * background[r].numpy())
        assert float(opacity[r]) == pytest.approx(1 - passed)
        assert float(depth[r]) == pytest.approx(far / max(1 - passed, 1e-6))


def test_gradients_of_compositing_equal_finite_differences():
    density, colour, t, dt, ray, background = samples()
    assert torch.autograd.gradcheck(
        lambda d, c, b: reference.composite(d, c, t, dt, ray, b),
        (density.requires_grad_(), colour.requires_grad_(), background.requires_grad_()),
    )


def march(
    origin, direction, occupied=None, jitter=0.0, step=0.25, near=0.0, far=50.0, unbounded=False, most=1000
):
    origin, direction = torch.tensor([origin], dtype=DOUBLE), torch.tensor([direction], dtype=DOUBLE)
    if occupied is None:
        occupied = torch.ones(4, 4, 4, dtype=torch.uint8)
    jitter = torch.tensor([jitter], dtype=DOUBLE)
    return reference.march(origin, direction, jitter, occupied, step, near, far, unbounded, most)


def test_a_bounded_march_fills_the_way_through_the_box_with_equal_intervals():
    t, dt, ray = march([-3.0, 0.1, 0.2], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(t, 2.125 + 0.25 * np.arange(8))  # the box is met from t = 2 to t = 4
    np.testing.assert_allclose(dt, 0.25)
    assert not ray.any()


def test_jitter_shifts_the_intervals_by_its_share_of_a_step():
    t, _, _ = march([-3.0, 0.1, 0.2], [1.0, 0.0, 0.0], jitter=0.4)
    np.testing.assert_allclose(t, 2.225 + 0.25 * np.arange(8))


def test_near_and_far_bound_the_march_and_most_bounds_its_samples():
    t, _, _ = march([-3.0, 0.1, 0.2], [1.0, 0.0, 0.0], near=2.5, far=3.5)
    np.testing.assert_allclose(t, 2.625 + 0.25 * np.arange(4))
    assert len(march([-3.0, 0.1, 0.2], [1.0, 0.0, 0.0], most=3)[0]) == 3


def test_a_ray_that_misses_the_box_has_no_sample():
    for origin, direction in (([-3.0, 2.0, 0.0], [1.0, 0.0, 0.0]), ([3.0, 0.0, 0.0], [1.0, 0.0, 0.0])):
        t, dt, ray = march(origin, direction)
        assert len(t) == len(dt) == len(ray) == 0


def test_only_samples_in_occupied_cells_live():
    occupied = torch.zeros(4, 4, 4, dtype=torch.uint8)
    occupied[2, 1, 3] = 1  # z, y, x: x from 0.5 to 1, y from -0.5 to 0, z from 0 to 0.5
    t, _, _ = march([-3.0, -0.2, 0.3], [1.0, 0.0, 0.0], occupied)
    np.testing.assert_allclose(t, [3.625, 3.875])
    assert len(march([-3.0, 0.2, 0.3], [1.0, 0.0, 0.0], occupied)[0]) == 0


def test_an_unbounded_march_goes_on_outside_with_growing_intervals():
    t, dt, _ = (a.numpy() for a in march([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], unbounded=True, far=30.0))
    start = t - dt / 2
    np.testing.assert_allclose(start[1:], (start + dt)[:-1])  # without gaps
    np.testing.assert_allclose(dt[start <= 1], 0.25)
    assert (np.diff(dt[start > 1]) > 0).all()
    assert t[-1] < 30 <= t[-1] + 3 * dt[-1] + dt[-1] ** 3


def test_bounded_positions_map_the_box_to_the_grid():
    x = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.5, 9.0]], dtype=DOUBLE)
    np.testing.assert_allclose(reference.grid_position(x, False), [[0, 0.5, 1], [0, 0.75, 1]], atol=1.1e-6)


def test_contraction_keeps_the_inner_box_and_brings_infinity_to_the_border():
    x = torch.tensor([[0.5, -1.0, 0.2], [1e9, 0.0, 0.0], [2.0, 4.0, -1.0]], dtype=DOUBLE)
    expected = [[0.625, 0.25, 0.55], [1.0, 0.5, 0.5], [0.5 + 0.875 / 4, 0.5 + 1.75 / 4, 0.5 - 0.4375 / 4]]
    np.testing.assert_allclose(reference.grid_position(x, True), expected, atol=1.1e-6)


def test_contraction_is_continuous_across_the_inner_box_in_value_and_slope():
    for direction in random(20, 3, seed=3) - 0.5:
        unit = direction / direction.abs().max()
        values = [
            reference.grid_position(s * unit[None], True)[0] for s in (1 - 2e-6, 1 - 1e-6, 1 + 1e-6, 1 + 2e-6)
        ]
        slopes = [(values[1] - values[0]) / 1e-6, (values[3] - values[2]) / 1e-6]
        torch.testing.assert_close(values[1], values[2], atol=1e-6, rtol=0)
        # Along the ray the slope is kept: d/ds (2 - 1/s) = 1 at s = 1.
        torch.testing.assert_close(slopes[0], slopes[1], atol=1e-4, rtol=0)


def test_the_jacobian_of_the_contraction_equals_finite_differences():
    points = (random(40, 3, seed=4) - 0.5) * torch.linspace(1, 8, 40, dtype=DOUBLE)[:, None]
    sizes = points.abs().sort(-1).values
    clear = points[
        (sizes[:, 2] - sizes[:, 1] > 0.05) & ((sizes[:, 2] - 1).abs() > 0.05)
    ]  # off edges and faces
    assert (clear.abs().amax(1) > 1).any()
    assert (clear.abs().amax(1) < 1).any()
    assert torch.autograd.gradcheck(lambda x: reference.grid_position(x, True), clear.requires_grad_())

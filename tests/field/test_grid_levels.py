"""The grids' layout against the numbers of the paper and of tiny-cuda-nn's conventions."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.field.grid_levels import grid_levels


def test_the_papers_pose_module_has_levels_of_16_34_and_72_all_dense():
    grid = grid_levels(3, 16, 72, 19)
    assert list(np.ceil(grid.scale.astype(float) - 1e-5) + 1) == [
        16,
        34,
        72,
    ]  # vertices that points can reach
    assert list(grid.stride) == [17, 35, 73]  # and one more a side, so that the far border does not wrap
    assert not grid.hashed.any()
    assert list(np.diff(grid.offset)) == [8 * -(-(n**3) // 8) for n in (17, 35, 73)]
    assert grid.width == 6


def test_the_papers_reconstruction_module_grows_by_the_cube_root_of_two_to_4096_all_hashed():
    grid = grid_levels(16, 128, 4096, 19)
    published = [128, 161, 203, 256, 323, 406, 512, 645, 813, 1024, 1290, 1625, 2048, 2580, 3251, 4096]
    np.testing.assert_allclose(grid.scale + 1, published, atol=0.6)
    np.testing.assert_allclose(grid.scale[1:] + 1, (grid.scale[:-1] + 1) * 2 ** (1 / 3), rtol=1e-5)
    assert grid.hashed.all()
    assert set(np.diff(grid.offset)) == {2**19}
    assert grid.entries == 16 * 2**19
    assert grid.width == 32


def test_a_level_is_hashed_exactly_when_its_vertices_outnumber_the_table():
    grid = grid_levels(2, 15, 16, 12)  # 16^3 = 4096 fits, 17^3 does not
    assert list(grid.stride) == [16, 17]
    assert list(grid.hashed) == [False, True]
    assert list(np.diff(grid.offset)) == [4096, 4096]


@pytest.mark.parametrize("levels", [1, 2, 7])
def test_levels_start_on_whole_lines_of_memory(levels):
    grid = grid_levels(levels, 5, 60, 14)
    assert not (grid.offset % 8).any()
    assert grid.levels == levels
    assert grid.scale[0] == pytest.approx(4)
    assert grid.scale[-1] == pytest.approx(59 if levels > 1 else 4)


def test_no_point_reaches_a_vertex_beyond_the_stride():
    for grid in (grid_levels(3, 16, 72, 19), grid_levels(7, 5, 60, 22)):
        cell = np.floor(grid.scale.astype(float) * 1.0 + 0.5)  # of the far border
        assert (cell + 1 < grid.stride).all()

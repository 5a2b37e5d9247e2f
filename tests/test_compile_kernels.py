"""What is compiled at install time is all that a run needs."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

from biresnerf.compile_kernels import compile_backward_kernels, compile_field_kernels, compile_kernels
from biresnerf.field.cpu import encoding, network, ray_kernels, samples, segments_backward
from biresnerf.refinement.adjustment.adjustment import adjust_poses, misfit
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.kernels import patches, tracks
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from tests.refinement.adjustment.rig import disturbed, observed
from tests.refinement.adjustment.test_patch_adjustment import Plane

pytestmark = pytest.mark.slow


ADJUSTMENT, FIELD = (patches, tracks), (encoding, network, ray_kernels, samples, segments_backward)


def compiled(modules: tuple[ModuleType, ...] = ADJUSTMENT) -> dict[str, int]:
    """For how many kinds of arguments each kernel is compiled; those inside others are not listed."""
    kernels = {f"{room.__name__}.{name}": k for room in modules for name, k in vars(room).items()}
    return {
        name: len(kernel.signatures)
        for name, kernel in kernels.items()
        if isinstance(kernel, Dispatcher) and kernel.signatures
    }


def test_an_adjustment_of_cameras_and_lenses_compiles_nothing_more():
    compile_kernels(field=False)
    before = compiled()
    rng = np.random.default_rng(2)
    plane = Plane(rng)
    start = disturbed(plane.truth, rng, 0.004, 0.004)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (80, 2)), np.zeros(80)])
    seen = observed(plane.truth, points, plane.intrinsics, rng, noise_px=0.1)
    lenses = Lenses(np.zeros(9, np.int64), np.zeros((1, 8)), np.array([[0.1] + [0.0] * 7]))
    evidence = Evidence(plane.intrinsics, seen, plane.evidence(start).patches, lenses)
    found = adjust_poses(start, evidence, PosePrior.equal(start, 0.02, 0.06))
    misfit(found.world_from_cam, evidence, 1.0)
    assert found.used
    assert len(before) >= 7
    assert compiled() == before


def test_the_backward_kernels_compiled_alone_are_those_of_a_step():
    """Otherwise a first run would compile them twice, the second time while nothing else goes on."""
    compile_field_kernels()
    of_a_step = compiled(FIELD)
    assert of_a_step["biresnerf.field.cpu.segments_backward.render_segments_backward"] == 1
    compile_backward_kernels()
    assert compiled(FIELD) == of_a_step


@pytest.mark.parametrize("first", ["biresnerf.resume", "biresnerf.refinement.kernels.batches"])
def test_kernels_are_found_in_the_cache_whichever_module_loads_numba(first):
    """The cache is asked for a processor, and Numba reads which one when it meets its first kernel."""
    program = f"""
import {first}
from numba.core.registry import cpu_target
print(*cpu_target.target_context.codegen().magic_tuple())
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == [*cpu_target.target_context.codegen().magic_tuple()]
    assert "-prefer-256-bit" in ran.stdout


@pytest.mark.parametrize("part", ["render", "gradients", "adjustment"])
def test_the_processes_that_a_run_starts_compile_without_an_error(part: str):
    """An error there would show only in time: the run itself would compile."""
    subprocess.run([sys.executable, "-m", "biresnerf.compile_kernels", part], check=True)

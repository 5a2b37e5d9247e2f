"""A step recorded once and repeated is the step itself. Shown without a GPU, see `emulated_graphs`."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton, which exists for Linux only")

from biresnerf.field.cuda import field as cuda_field
from biresnerf.field.cuda.field import CudaField
from biresnerf.field.occupancy import DeviceOccupancyGrid
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.optimise import graph_check, joint_step
from biresnerf.refinement.optimise.async_metrics import StepResult
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.step_graphs import StepGraphs, slower_steps
from biresnerf.refinement.parameters.intrinsics_parameters import lenses_of
from biresnerf.refinement.scene.scene_frame import scene_frame
from tests.refinement.optimise.emulated_graphs import as_on_a_gpu, cast_as_on_a_gpu, emulated_graph
from tests.refinement.optimise.one_colour_field import OneColourField
from tests.refinement.tiny_scene import CPU, tiny_options, tiny_set

HELD_OUT = [3]
CAMERA = Camera("SIMPLE_PINHOLE", 24, 24, (33.0, 12.0, 12.0))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(autouse=True)
def by_kernels(monkeypatch):
    monkeypatch.setattr(joint_step, "cast_rays", cast_as_on_a_gpu)
    monkeypatch.setattr(cuda_field, "RAYS_LEAST", 32)  # Triton's interpreter takes its time


def made(
    tiny, record=emulated_graph, *, stage=1, bodies=None, doubted=None, held=False, **options
) -> JointOptimiser:
    """An optimiser whose steps are taken as on a GPU."""
    dataset, images = tiny
    frame = scene_frame(dataset.world_from_cam, images)
    start = frame.unit_from_world.apply_to_poses(dataset.world_from_cam)
    chosen = tiny_options(**options)
    lenses = lenses_of(dataset, images, chosen.refine_intrinsics, HELD_OUT, CPU)
    optimiser = JointOptimiser(
        images, frame, start, chosen, HELD_OUT, CPU, 2, bodies=bodies, lenses=lenses
    )  # fmt: skip
    optimiser.field, optimiser.occupancy = OneColourField(), DeviceOccupancyGrid(8, CPU)
    optimiser.sampler.long_side = 400  # so that blur matters
    as_on_a_gpu(optimiser, record)
    if stage == 2:
        optimiser.start_reconstruction()
    if doubted is not None:
        optimiser.camera_errors.doubt(doubted)
    optimiser.poses_held = held
    return optimiser


def pair(tiny, **options) -> tuple[JointOptimiser, JointOptimiser]:
    """Two of the same; the first takes its steps operation by operation."""
    plain, recorded = made(tiny, **options), made(tiny, **options)
    plain.graphs.fault = "not wanted here"
    return plain, recorded


def steps(optimisers, rays: list[int]) -> list[list[StepResult]]:
    """A step for each number of rays; what each optimiser's steps tell."""
    told: list[list[StepResult]] = [[] for _ in optimisers]
    for optimiser, results in zip(optimisers, told, strict=True):
        for count in rays:
            optimiser.rays = count
            results.append(optimiser.step())
    return told


def differing(plain: JointOptimiser, recorded: JointOptimiser) -> set[str]:
    """The names of the tensors that are not exactly the same."""
    found, expected = recorded.state(), plain.state()
    assert found.keys() == expected.keys()
    return {name for name, tensor in expected.items() if not torch.equal(found[name], tensor)}


RIG = RigidBodies(np.arange(7) // 2, np.zeros(7, bool))  # every two cameras
GUESSED = np.arange(7) == 2


@pytest.mark.parametrize(
    "what",
    [
        {},
        {"stage": 2},
        {"refine_intrinsics": "all"},
        {"exposure": "on"},
        {"bodies": RIG},
        {"doubted": GUESSED},
        {"held": True},
    ],
    ids=lambda what: "-".join(what) or "stage 1",
)
def test_repeated_steps_are_exactly_those_taken_one_by_one(tiny, what):
    plain, recorded = pair(tiny, **what)
    for rays in ([40] * 9, [40] * 2, [50] * 4, [40] * 2):
        expected, told = steps((plain, recorded), rays)
        assert told == expected
        assert torch.equal(recorded.intrinsics.fx, plain.intrinsics.fx)
    assert recorded.graphs.fault is None
    assert recorded.graphs.repeated >= 7
    assert differing(plain, recorded) == set()
    assert plain.step_state() == recorded.step_state()


@pytest.mark.slow
def test_the_kernels_steps_are_those_of_their_graphs_in_both_stages(tiny):
    plain, recorded = pair(tiny)
    for optimiser in (plain, recorded):
        optimiser.field = CudaField(OneColourField.SHAPE, 0, CPU, samples=2048)
    steps((plain, recorded), [16] * 6)
    in_stage_1 = recorded.graphs.repeated
    for optimiser in (plain, recorded):
        optimiser.start_reconstruction()
    steps((plain, recorded), [16] * 5)
    assert recorded.graphs.fault is None
    assert in_stage_1 >= 2
    assert recorded.graphs.repeated - in_stage_1 >= 2
    assert differing(plain, recorded) == set()


def replace_a_pose(optimiser: JointOptimiser) -> None:
    optimiser.replace_pose(4, optimiser.poses.matrices()[5].detach())


def load_a_state(optimiser: JointOptimiser) -> None:
    saved = {name: tensor.clone() for name, tensor in optimiser.state().items()}
    optimiser.load_state(saved, optimiser.step_state())


@pytest.mark.parametrize(
    "change",
    [
        replace_a_pose,
        load_a_state,
        lambda optimiser: optimiser.start_reconstruction(),
        lambda optimiser: optimiser.poses.restart_adam(),
        lambda optimiser: optimiser.exposure.restart_adam(),
        lambda optimiser: optimiser.camera_errors.doubt(GUESSED),
        lambda optimiser: setattr(optimiser, "poses_held", True),
        lambda optimiser: optimiser.lenses.place([CAMERA], [replace(CAMERA, params=(34.0, 12.0, 12.0))]),
    ],
    ids=["pose", "state", "stage", "adam", "exposures", "weights", "held", "lens"],
)
def test_what_changes_between_steps_reaches_the_next_one(tiny, change):
    plain, recorded = pair(tiny, exposure="on")
    steps((plain, recorded), [40] * 5)
    for optimiser in (plain, recorded):
        change(optimiser)
    steps((plain, recorded), [40] * 5)
    assert recorded.graphs.repeated >= 3
    assert differing(plain, recorded) == set()


def with_own(name: str):
    """A number of the step when it was recorded, in place of the one in memory."""
    return lambda told, written: replace(written, **{name: getattr(told, name)})


@pytest.mark.parametrize(
    ("baked", "wrong"),
    [
        (with_own("pose_rate"), "poses.rotation"),
        (with_own("lens_rate"), "lenses.increments"),
        (with_own("rates"), "field.weights"),
        (lambda told, written: replace(written, blur=written.blur.clone()), "field.weights"),
    ],
    ids=["pose rate", "lens rate", "field rates", "blur"],
)
def test_a_number_that_does_not_lie_in_memory_is_found(tiny, monkeypatch, baked, wrong):
    plain, recorded = pair(tiny, refine_intrinsics="all")
    for optimiser in (plain, recorded):
        optimiser.step_index = 7  # lenses move
    written = StepGraphs._written
    monkeypatch.setattr(StepGraphs, "_written", lambda graphs, told: baked(told, written(graphs, told)))
    steps((plain, recorded), [40] * 3)
    assert differing(plain, recorded) == set()  # recorded with the numbers of this step
    steps((plain, recorded), [40] * 2)
    assert recorded.graphs.repeated == 3
    assert wrong in differing(plain, recorded)


def test_random_numbers_that_are_drawn_while_recording_only_are_found(tiny, monkeypatch):
    draw, drawn = torch.rand, torch.rand(40, 2)

    def once(*size, generator=None, **where):
        return drawn if size == (40, 2) else draw(*size, generator=generator, **where)

    plain, recorded = pair(tiny)
    steps((plain,), [40] * 5)
    monkeypatch.setattr(torch, "rand", once)
    steps((recorded,), [40] * 5)
    assert "field.weights" in differing(plain, recorded)


def broken(work, draws, other):
    raise RuntimeError("CUDA error: operation not permitted when stream is capturing")


def twice(work, draws, other):
    graph, outcome = emulated_graph(work, draws)
    replay = graph.replay
    graph.replay = lambda: (replay(), replay())
    return graph, outcome


@pytest.mark.parametrize(
    ("record", "said"), [(broken, "not permitted when stream"), (twice, "differs from the step itself")]
)
def test_without_a_right_graph_steps_go_on_one_by_one_and_a_warning_says_so(tiny, caplog, record, said):
    plain, recorded = made(tiny), made(tiny, record=record)
    plain.graphs.fault = "not wanted here"
    steps((plain, recorded), [40] * 6)
    assert recorded.graphs.repeated == 0
    assert differing(plain, recorded) == set()
    assert [said in warning for warning in slower_steps(recorded)] == [True]
    assert [said in record.message for record in caplog.records] == [True]


def test_a_step_that_waits_for_a_value_is_not_recorded(tiny):
    optimiser = made(tiny)
    optimiser.exposure.shown = lambda rendering, image: rendering.colour * float(image.sum() >= 0)
    steps((optimiser,), [40] * 5)
    assert "cannot wait for a value" in slower_steps(optimiser)[0]
    assert optimiser.step_index == 5


def test_a_dropped_optimiser_frees_its_memory_at_once(tiny):
    optimiser = made(tiny)
    steps((optimiser,), [40] * 5)
    held = weakref.ref(optimiser)
    gc.disable()
    try:
        del optimiser
        assert held() is None
    finally:
        gc.enable()


def test_sizes_of_steps_are_few_and_near_any_number_of_rays():
    sizes = {StepGraphs.rays_of_size(rays) for rays in range(256, 1 << 15)}
    assert len(sizes) == 7 * 8 + 1
    assert all(StepGraphs.rays_of_size(size) == size for size in sizes)
    assert all(abs(StepGraphs.rays_of_size(rays) / rays - 1) < 0.05 for rays in range(256, 1 << 15))


def test_the_check_of_a_gpu_names_what_is_wrong(tiny):
    assert graph_check.faults(made(tiny), steps=6) == ()
    assert "differs" in graph_check.faults(made(tiny, record=twice), steps=6)[0]
    assert graph_check.faults(made(tiny), steps=2) == ("no step of stage 1 could be repeated",)


def test_a_gpu_that_failed_its_check_records_nothing(tiny):
    optimiser, recorded = made(tiny), []
    optimiser.graphs = StepGraphs(optimiser, recorded.append, check=lambda: ("the check failed: signal 11",))
    steps((optimiser,), [40] * 4)
    assert recorded == []
    assert "signal 11" in slower_steps(optimiser)[0]


def test_the_scene_of_the_check_can_be_optimised():
    optimiser = graph_check.small_optimiser(CPU)
    optimiser.rays = 64
    assert optimiser.step().samples > 64

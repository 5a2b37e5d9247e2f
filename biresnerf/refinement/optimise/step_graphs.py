"""Steps of the joint optimisation as CUDA graphs: the host launches one graph in place of hundreds of operations.

A graph repeats launches with the same arguments. So whatever changes from step to step lies in the device's memory
and is written there before a step; tensors stay where they are, or the graphs are dropped; and there is a graph for
each form that a step can have, the number of rays among it.
"""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, cast

import torch
from torch import Tensor

from biresnerf.field.radiance_field import (
    FieldRates,
    Marching,
    PositionGradient,
    Rays,
    RecordableField,
    Rendering,
)
from biresnerf.refinement.optimise.joint_step import StepNumbers, StepOutcome, joint_step
from biresnerf.refinement.optimise.optimiser_state import Part, state_of

if TYPE_CHECKING:
    from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser

logger = logging.getLogger(__name__)

SIZES_PER_OCTAVE = 8  # numbers of rays that steps have, so that few graphs serve all
# Of how far a step moves a tensor, how much its repetition by a graph may differ. Atomic additions come in another
# order every time, and where a gradient is nearly zero Adam takes its sign.
TOLERANCE = 0.05
ROUNDING = 1e-6  # of a tensor's size
CONTROLS = ("pose_rate", "lens_rate", "networks", "columns", "blur_level", "blur_share")


class Graph(Protocol):
    """Recorded launches."""

    def replay(self) -> None: ...


Work = Callable[[], StepOutcome]
# Work that only launches, the generator that it draws from, and another graph, if there is one -> the graph of the
# work, which no one runs while another runs, and what the work returned.
Record = Callable[[Work, torch.Generator, Graph | None], tuple[Graph, StepOutcome]]
Check = Callable[[], tuple[str, ...]]


def graph_faults() -> tuple[str, ...]:
    """What is wrong with recorded steps on this GPU, as its first use found out; see `graph_check`."""
    from biresnerf.field.cuda.device_check import remembered_faults

    return remembered_faults("biresnerf.refinement.optimise.graph_check")


def cuda_graph(work: Work, draws: torch.Generator, other: Graph | None) -> tuple[Graph, StepOutcome]:
    """`Record` by CUDA. All graphs share their memory."""
    graph = torch.cuda.CUDAGraph()
    graph.register_generator_state(draws)
    pool = other.pool() if isinstance(other, torch.cuda.CUDAGraph) else None
    with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
        outcome = work()
    return graph, outcome


class StepGraphs:
    """Takes the steps of an optimiser: the first of each form operation by operation, later ones by its graph.

    A graph's first repetition is compared with the same step taken operation by operation. If recording fails or they
    differ, steps go on without graphs, with a warning.

    Args:
        record: how work is recorded.
        check: what an earlier check found to be wrong with graphs here; asked before the first is made.

    Attributes:
        fault: why there are no graphs any more; None where there are.
        repeated: steps that graphs have taken.
    """

    def __init__(
        self, optimiser: JointOptimiser, record: Record = cuda_graph, check: Check = graph_faults
    ) -> None:
        # Not kept alive: an optimiser that is dropped frees its device's memory at once.
        self.optimiser: JointOptimiser = weakref.proxy(optimiser)
        self.fault: str | None = None
        self.repeated = 0
        self._record, self._check = record, check
        self._controls = torch.zeros(len(CONTROLS), device=optimiser.device)
        self._places: Hashable = None
        self._graphs: dict[Hashable, tuple[Graph, StepOutcome] | None] = {}  # None: taken once

    @property
    def _field(self) -> RecordableField:
        return cast(RecordableField, self.optimiser.field)

    @staticmethod
    def can_take(optimiser: JointOptimiser) -> bool:
        """Whether there is a GPU, and no step waits for it or asks the host for more than `StepNumbers`."""
        on_gpu = optimiser.device.type == "cuda" and optimiser.field.recordable
        return on_gpu and not optimiser.poses.double_step

    @staticmethod
    def rays_of_size(rays: int) -> int:
        """The next number of rays that steps have."""
        return round(2 ** (round(SIZES_PER_OCTAVE * math.log2(rays)) / SIZES_PER_OCTAVE))

    def forget(self) -> None:
        """Drop all graphs with their memory."""
        self._graphs.clear()

    def step(self, told: StepNumbers) -> StepOutcome:
        """`joint_step`."""
        optimiser, field = self.optimiser, self._field
        trained = optimiser.sampler.trained(told.rays)
        samples = field.prepare(told.rays, trained, told.marching, told.gradient, told.rates)
        if samples is None:
            return joint_step(optimiser, told, field)
        written = self._written(told)
        outcome = self._taken(told, lambda: joint_step(optimiser, written, _Prepared(field)))
        field.finish()
        if told.moves_lenses:
            optimiser.lenses.forget_present()
        return replace(outcome, samples=samples)

    def _written(self, told: StepNumbers) -> StepNumbers:
        """The same with its numbers in the device's memory."""
        assert isinstance(told.blur, float)
        blur = (
            self.optimiser.sampler.random_blur(told.blur, self.optimiser.draws) if told.blur > 0 else (0, 0.0)
        )
        rates = told.rates
        values = [told.pose_rate, told.lens_rate, rates.networks, rates.reconstruction_columns, *blur]
        self._controls.copy_(torch.tensor(values), non_blocking=True)
        pose_rate, lens_rate, networks, columns, *_ = self._controls.unbind()
        return replace(
            told,
            pose_rate=pose_rate,
            lens_rate=lens_rate,
            rates=replace(rates, networks=networks, reconstruction_columns=columns),
            blur=self._controls[4:] if told.blur > 0 else None,
        )

    def _form(self, told: StepNumbers) -> Hashable:
        """What decides which launches a step has, as long as tensors stay where they are."""
        optimiser, moves = self.optimiser, (told.moves_poses, told.moves_lenses, told.moves_focal)
        return told.rays, moves, told.blur != 0, optimiser.switch is None, optimiser.lenses.given.terms

    def _taken(self, told: StepNumbers, work: Work) -> StepOutcome:
        if self.fault is not None:
            return work()
        form, places = self._form(told), self._places_of(told)
        if places != self._places:
            self.forget()
            self._places = places
        if form not in self._graphs:
            self._graphs[form] = None
            return work()
        found = self._graphs[form] or self._recorded(told, work)
        if found is None:
            return work()
        self._graphs[form] = found
        graph, outcome = found
        graph.replay()
        self.repeated += 1
        return outcome

    def _recorded(self, told: StepNumbers, work: Work) -> tuple[Graph, StepOutcome] | None:
        """A graph of the step, which remains to be taken; None where it could not be made or is wrong."""
        found = next(iter(self._check()), None) or self._tried(told, work)
        if not isinstance(found, str):
            return found
        self.fault = found
        self._forget_gradients()
        self.forget()
        logger.warning("%s", slower_steps(self.optimiser)[0])
        return None

    def _tried(self, told: StepNumbers, work: Work) -> tuple[Graph, StepOutcome] | str:
        """A graph of the step that repeats it; or why there is none."""
        tensors = self._moved(told)
        other = next((made[0] for made in self._graphs.values() if made is not None), None)
        self._forget_gradients()
        try:
            with self._undone(tensors) as before:
                graph, outcome = self._record(work, self.optimiser.draws, other)
                graph.replay()
                repeated = _copies([*tensors, outcome.loss, outcome.error])
            with self._undone(tensors):
                once = work()
                expected = _copies([*tensors, once.loss, once.error])
        except RuntimeError as error:  # what CUDA does not allow here
            return f"a step could not be recorded: {error}"
        same = _agree(before, repeated, expected)
        return (graph, outcome) if same else "a recorded step differs from the step itself"

    @contextmanager
    def _undone(self, tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
        """Undo afterwards what happens to tensors and random numbers; gives copies of the tensors."""
        draws = self.optimiser.draws
        before, chance = _copies(tensors), draws.get_state()
        try:
            yield before
        finally:
            for tensor, value in zip(tensors, before, strict=True):
                tensor.copy_(value)
            draws.set_state(chance)

    def _moved(self, told: StepNumbers) -> list[Tensor]:
        """The tensors that a step changes."""
        o = self.optimiser
        parts: dict[str, Part] = {"field": o.field, "poses": o.poses, "exposure": o.exposure}
        if told.moves_lenses:
            parts["lenses"] = o.lenses
        state = state_of(parts)
        del state["field.counters"]  # a copy of the host's
        return [*state.values(), o.camera_errors.sums]

    def _places_of(self, told: StepNumbers) -> Hashable:
        """Where the tensors lie that a step reads or changes."""
        o = self.optimiser
        read = [*self._moved(told), o.mobility]
        if o.camera_errors.weights is not None:
            read.append(o.camera_errors.weights)
        if not told.moves_lenses:
            lenses = o.intrinsics
            read += [lenses.fx, lenses.fy, lenses.cx, lenses.cy, lenses.distortion]
        return self._field.place, *(tensor.data_ptr() for tensor in read)

    def _forget_gradients(self) -> None:
        """Memory of a graph must not remain as a gradient, nor a gradient as input of a graph."""
        o = self.optimiser
        for part in (o.poses, o.lenses, o.exposure):
            part.forget_gradients()
        o.field.discard_gradients()


class _Prepared:
    """A field whose numbers are written already."""

    def __init__(self, field: RecordableField) -> None:
        self._field = field

    def render(self, rays: Rays, _marching: Marching, _gradient: PositionGradient) -> Rendering:
        return self._field.render_prepared(rays)

    def step(self, rates: FieldRates) -> None:
        self._field.step_prepared(rates)


def slower_steps(optimiser: JointOptimiser) -> tuple[str, ...]:
    """A warning where steps could not be recorded."""
    fault = optimiser.graphs and optimiser.graphs.fault
    if not fault:
        return ()
    return (f"Steps take longer, without a CUDA graph of the whole step: {fault}.",)


def _copies(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


def _agree(before: Sequence[Tensor], repeated: Sequence[Tensor], expected: Sequence[Tensor]) -> bool:
    """Whether a repeated step moved everything as expected; what was not there `before` began at zero."""
    for i, (found, wanted) in enumerate(zip(repeated, expected, strict=True)):
        began = before[i] if i < len(before) else torch.zeros_like(wanted)
        apart, moved, size = (float(each.norm()) for each in (found - wanted, wanted - began, wanted))
        if not apart <= TOLERANCE * moved + ROUNDING * size:
            return False
    return True

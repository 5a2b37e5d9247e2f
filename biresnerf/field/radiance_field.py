"""The radiance field's contract: its operations, inputs and outputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor

from biresnerf.field.grid_levels import GridLevels


@dataclass(frozen=True)
class FieldShape:
    """The parts of a field on grids. `unbounded` scenes are contracted outside the inner box [-1, 1]^3.

    `broadcast`: levels of the first grid open from coarse to fine, closed ones repeating the finest open one
    (`coarse_to_fine.level_mixing`).
    """

    pose_grid: GridLevels
    reconstruction_grid: GridLevels
    unbounded: bool
    broadcast: bool = False


@dataclass(frozen=True)
class Rays:
    """Rays in the unit frame: origin, unit direction, background colour [rays, 3], jitter in [0, 1).

    `jitter` is where in their interval samples start: [rays], or [rays, samples] for a stratified field.

    Only the first `trained` rays give gradients to the field; all give gradients to origin and direction.
    """

    origin: Tensor
    direction: Tensor
    background: Tensor
    jitter: Tensor
    trained: int


@dataclass(frozen=True)
class Merging:
    """Neighbouring intervals of a ray become one where they give little light: see `reference.merge`.

    Those that are merged give at most the share `light` of the ray's light, and are at most `most`.
    """

    light: float
    most: int


@dataclass(frozen=True)
class Marching:
    """Where samples are taken: interval `step`, from `near` to `far` (unit lengths), at most `most` per ray.

    `occupied` is the occupancy grid, uint8 [side, side, side] over (z, y, x) of the grid position. Every interval is a
    sample where `merging` is None.
    """

    step: float
    near: float
    far: float
    most: int
    occupied: Tensor
    merging: Merging | None = None


@dataclass(frozen=True)
class PositionGradient:
    """How the encodings' gradient to positions is shaped (see `reference.straight_through_fraction`).

    `reconstruction_share` scales what the reconstruction module passes on: 0 right after the switch, then 1.
    """

    pose_smoothing: float = 0.0
    reconstruction_smoothing: float = 0.0
    reconstruction_share: float = 1.0


@dataclass(frozen=True)
class FieldRates:
    """Rates of one step: pose module and networks, reconstruction module per level, its first-layer columns."""

    pose: float
    networks: float
    reconstruction: tuple[float, ...]
    reconstruction_columns: float


@dataclass(frozen=True)
class Rendering:
    """Colour [rays, 3], opacity [rays] and depth [rays] (unit lengths along the ray).

    `samples` is how many there were before any were merged.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    samples: int


class RadianceField(ABC):
    """The interface between the joint optimisation and every kind of field.

    Attributes:
        unbounded: whether space outside the inner box [-1, 1]^3 is contracted.
        stratified: samples a ray gets, one from each of as many bins; None where rays are marched through the
            occupancy grid.
    """

    backend: str
    unbounded: bool
    stratified: int | None = None

    @abstractmethod
    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        """Colour, opacity and depth along rays; differentiable to origin and direction.

        Calling backward on the result leaves the trained rays' field gradients ready for `step`.
        """

    @abstractmethod
    def density(self, position: Tensor) -> Tensor:
        """Density [n] per unit length at grid positions [n, 3] in [0, 1]; no gradient."""

    def estimate(self, position: Tensor, count: Tensor | None = None) -> Tensor:
        """Density [n] at grid positions [n, 3] as the pose-estimation module alone gives it; no gradient.

        A field without modules has only its density. If `count` [1] is given, only the first `count` densities matter:
        a backend may leave the others out if it need not wait for the number.
        """
        return self.density(position)

    @abstractmethod
    def step(self, rates: FieldRates) -> None:
        """One optimiser step from the gradients of the last backward."""

    @abstractmethod
    def discard_gradients(self) -> None:
        """Discard the gradients of the last backward."""

    def release_memory(self) -> None:
        """Free the memory of a step besides the field itself; the next step allocates it again as needed."""
        self.discard_gradients()

    @abstractmethod
    def state(self) -> dict[str, Tensor]:
        """Everything that `load_state` needs to continue exactly, as flat named tensors."""

    @abstractmethod
    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned, in place."""

    def start_reconstruction(self) -> None:
        """Add the reconstruction module (the switch to stage 2); an error if there is none."""
        raise RuntimeError("this field has no second stage")

    @abstractmethod
    def reach(self, progress: float) -> None:
        """Set the completed share of the run, 0 to 1; a field that opens from coarse to fine follows it."""

"""The solver's interface to one kind of evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from biresnerf.arrays import Array
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.solver.blocks import Blocks


@dataclass(frozen=True, eq=False)
class Linearised:
    """A robust cost near some cameras, without the unknowns that the term keeps to itself.

    Attributes:
        system: added to the normal equations of cameras and lenses: J^T W J.
        right: half the gradient [u]: J^T W r.
        back: what the term needs to move its own unknowns along.
    """

    system: Blocks
    right: Array
    back: tuple[Any, ...]


class Term(Protocol):
    """Residuals of one kind, with unknowns of their own (points, scales) that no other term has.

    The unknowns are an array that the term alone reads. Cost is the sum of S^2 e^2 / (S^2 + e^2) (Geman and McClure)
    over residuals e in noise levels.
    """

    unknowns: Array

    def measure(self, cameras: Cameras) -> float:
        """Settle the unknowns and set the noise level from the present residuals; returns its relative change."""

    def cost(self, cameras: Cameras, unknowns: Array) -> float:
        """The robust cost."""

    def linearise(self, cameras: Cameras, damping: float) -> Linearised:
        """Normal equations at the term's present unknowns; `damping` as for the cameras."""

    def stepped(self, linearised: Linearised, motion: Array) -> Array:
        """The unknowns after a step [u] of cameras and lenses."""

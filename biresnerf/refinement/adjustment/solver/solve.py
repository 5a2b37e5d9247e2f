"""Levenberg-Marquardt over cameras and lenses: terms with their own unknowns eliminated, and a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.evidence import PosePrior
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.body_motions import BodyMoves, rigid_motion
from biresnerf.refinement.adjustment.solver.elimination import solution
from biresnerf.refinement.adjustment.solver.term import Linearised, Term

ROUNDS = 8  # of measuring the noise; it falls with the residuals, and with it what counts as wrong
STEPS = 10  # of each round, at most
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e6
CONVERGED = 1e-7  # a lower relative gain ends a round
SETTLED = 1e-3  # a lower relative change of all noise levels ends the rounds


@dataclass(frozen=True, eq=False)
class Prior:
    """The prior as a quadratic cost of cameras and lenses.

    Attributes:
        mean: the cameras a priori.
        weight: inverse variances [u]; zero where nothing is known.
        free: which of the u = 6n + 8g unknowns may move.
        bodies: of the cameras, with all fixed that cannot move.
    """

    mean: Cameras
    weight: Array
    free: NDArray[np.bool_]
    bodies: RigidBodies

    @classmethod
    def of(cls, prior: PosePrior, lenses: Lenses | None = None) -> Prior:
        deviation = np.repeat(np.stack([prior.rotation, prior.position], 1), 3, axis=1).reshape(-1)
        free = ~np.repeat(prior.fixed, POSE)
        if lenses is not None:
            deviation = np.concatenate([deviation, lenses.deviation.reshape(-1)])
            free = np.concatenate([free, lenses.free.reshape(-1)])
        usable = np.isfinite(deviation) & (deviation > 0)
        weight = np.where(usable, 1 / np.where(usable, deviation, 1.0) ** 2, 0.0)
        return cls(
            Cameras.of(prior.world_from_cam, lenses), weight, free, RigidBodies(prior.bodies.of, prior.fixed)
        )

    def cost(self, cameras: Cameras) -> float:
        return float((self.weight * cameras.apart(self.mean) ** 2).sum())

    def right(self, cameras: Cameras) -> Array:
        """Half the gradient [u], to first order in the rotations' distance."""
        return np.asarray(self.weight * cameras.apart(self.mean))

    def moves(self, cameras: Cameras) -> BodyMoves | None:
        """How cameras follow bodies; None where each is free for itself."""
        if not self.bodies.shared:
            return None
        return BodyMoves.among(cameras, self.bodies)

    def rigid(self, cameras: Cameras, motion: Array) -> Array:
        """An increment [u] along `moves`, with bodies rigid to more than first order."""
        if not self.bodies.shared:
            return motion
        poses, lenses = cameras.split(motion)
        return np.concatenate([rigid_motion(cameras, self.bodies, poses).reshape(-1), lenses.reshape(-1)])


def minimise(cameras: Cameras, terms: Sequence[Term], prior: Prior) -> Cameras:
    """The cameras of least robust cost that is found from here; updates the terms' unknowns and noise levels."""
    for round in range(ROUNDS):
        changes = [term.measure(cameras) for term in terms]
        if round > 0 and max(changes, default=0.0) < SETTLED:
            break
        cameras = _descend(cameras, terms, prior)
    return cameras


def _descend(cameras: Cameras, terms: Sequence[Term], prior: Prior) -> Cameras:
    """Steps at fixed noise levels."""
    damping = DAMPING
    cost = prior.cost(cameras) + sum(term.cost(cameras, term.unknowns) for term in terms)
    for _ in range(STEPS):
        linear = [term.linearise(cameras, damping) for term in terms]
        better = None
        while better is None and damping < MOST_DAMPING:
            better = _step(cameras, terms, prior, linear, damping, cost)
            damping = damping * 10 if better is None else max(damping / 10, LEAST_DAMPING)
        if better is None:
            break
        gain = cost - better[1]
        cameras, cost = better
        if gain < CONVERGED * cost:
            break
    return cameras


def _step(
    cameras: Cameras,
    terms: Sequence[Term],
    prior: Prior,
    linear: Sequence[Linearised],
    damping: float,
    cost: float,
) -> tuple[Cameras, float] | None:
    """Cameras and cost after a step, with the terms' unknowns moved along; None if it does not lower the cost."""
    motion = newton_step(cameras, linear, prior, damping)
    if motion is None:
        return None
    moved = cameras.moved(motion)
    unknowns = [term.stepped(at, motion) for term, at in zip(terms, linear, strict=True)]
    after = prior.cost(moved) + sum(t.cost(moved, u) for t, u in zip(terms, unknowns, strict=True))
    if not after < cost:
        return None
    for term, found in zip(terms, unknowns, strict=True):
        term.unknowns = found
    return moved, after


def newton_step(
    cameras: Cameras, linear: Sequence[Linearised], prior: Prior, damping: float = 0.0
) -> Array | None:
    """The increment [u] of cameras and lenses to the least linearised cost, damped; None where nothing is known."""
    system, right = normal_equations(cameras, linear, prior)
    moves = prior.moves(cameras)
    if moves is None:
        return _damped(system, right, prior.free, damping)
    system, (poses, lenses) = moves.reduced(system), cameras.split(right)
    right = np.concatenate([moves.of_bodies(poses).reshape(-1), lenses.reshape(-1)])
    free = np.concatenate([np.ones(POSE * moves.bodies, np.bool_), prior.free[POSE * len(cameras) :]])
    along = _damped(system, right, free, damping)
    if along is None:
        return None
    bodies, lens_steps = np.split(along, [POSE * moves.bodies])
    motion = moves.of_cameras(bodies.reshape(-1, POSE))
    return prior.rigid(cameras, np.concatenate([motion.reshape(-1), lens_steps]))


def _damped(system: Blocks, right: Array, free: NDArray[np.bool_], damping: float) -> Array | None:
    """The damped step of the unknowns that are free and that anything is known of; None where there is none."""
    diagonal = system.diagonal
    free = (diagonal > 0) & free
    if not free.any():
        return None
    # What is not positive definite will be, damped more.
    return solution(system.with_diagonal(damping * diagonal), -right, free)


def normal_equations(cameras: Cameras, linear: Sequence[Linearised], prior: Prior) -> tuple[Blocks, Array]:
    """The matrix and half the gradient [u] of cameras and lenses alone."""
    system, right = linear[0].system, prior.right(cameras) + linear[0].right
    for at in linear[1:]:
        system, right = system + at.system, right + at.right
    return system.with_diagonal(prior.weight), right

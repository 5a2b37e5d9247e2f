"""The offset on the camera's side that all given poses share: a tracked body, a robot's flange, other axes, a roll.

A given pose is ``frame(world_from_cam) @ cam_from_body``: a similarity on the world's side, one rigid motion on the
camera's. Both are estimated together (the robot-world, hand-eye problem: Zhuang, Roth and Sudhakar 1994), robustly,
from poses that other evidence gave.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import permutations, product

import numpy as np

from biresnerf.arrays import Array
from biresnerf.geometry.rigid import motion_of, rigid_inverse, rotation_of, rotation_vectors
from biresnerf.geometry.similarity import Similarity, align_robust

FRAME, TURN = 7, 3  # unknowns
LEAST_CAMERAS = 5
# An error of so many deviations, of each of six deviates, has lost three quarters of its weight.
ROBUST = 3 * 3.0**2
# Errors of neighbours are alike and do not average out: by how much deviations count for more (docs/estimator.md).
SHARED_ERRORS = 2.0
INDEPENDENT = 12  # cameras at most that support an offset: along a path, errors add up
FREEDOM = 4.0  # of Student's distribution, which errors are taken to have where offsets are compared
STRONG = 10.0  # twice the logarithm of a Bayes factor (Kass and Raftery 1995)
# A shift along a direction is left out if it is so few deviations from zero, and known no better than to this share of
# the spread of the cameras.
TOLD, VAGUE = 3.0, 0.05
SAME = 1e-3  # of the largest singular value: what is smaller cannot be determined
FURTHEST = 0.3  # rad, and spreads of the rig: the longest step
SETTLED = 1e-6  # of a standard deviation
MAXWELL_MEDIAN = 1.5382  # of the length of three normal deviates
ROUNDS = 30
EXACT = 1e-7  # rad, and shares of the cameras' spread: no pose is known better
MOST_TRIED, STARTS = 200, 3  # cameras that turns are tried with, and turns that are refined


def _axes_turned() -> Array:
    """The 24 rotations [24, 3, 3] that carry axes to axes; the identity first."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    )
    return np.stack([each for each in signed if np.linalg.det(each) > 0])


AXES = _axes_turned()


@dataclass(frozen=True, eq=False)
class BodyOffset:
    """The offset that all given poses share: ``given @ body_from_cam`` are the cameras' poses.

    Attributes:
        body_from_cam: [4, 4], in the given unit; its shift is zero along directions in which it is not known.
        shift_deviation: standard deviation along the least certain known direction, in the given unit; or None.
        known_along: directions in which the shift is known, or known to be zero: orthonormal columns [3, k] in the axes
            of the body.
    """

    body_from_cam: Array
    shift_deviation: float | None
    known_along: Array = field(default_factory=lambda: np.zeros((3, 0)))

    def then(self, further: BodyOffset | None) -> BodyOffset:
        """Compose with a further offset, found after this one was removed."""
        if further is None:
            return self
        known = [each for each in (self.shift_deviation, further.shift_deviation) if each is not None]
        along = np.concatenate([self.known_along, self.body_from_cam[:3, :3] @ further.known_along], axis=1)
        basis, lengths, _ = np.linalg.svd(along, full_matrices=False)
        return BodyOffset(
            self.body_from_cam @ further.body_from_cam,
            max(known, default=None),
            basis[:, lengths > SAME] if along.shape[1] else along,
        )


@dataclass(frozen=True, eq=False)
class Tie:
    """How given poses relate to those of other evidence.

    Attributes:
        given_from_fitted: the frame.
        offset: None where the errors show none.
        rotation, position: standard deviation of each component of the errors: rad, and the given unit.
        weight: of each camera [n], 0 to 1; 0 for one far off.
        likelihood: twice its logarithm, where errors are alike.
        price: what the unknowns could explain of it by chance (Schwarz 1978).
    """

    given_from_fitted: Similarity
    offset: BodyOffset | None
    rotation: float
    position: float
    weight: Array
    likelihood: float
    price: float

    def explains_more_than(self, other: Tie) -> bool:
        """Whether to believe this tie rather than another of the same cameras that is likelier a priori."""
        counted = min(1.0, INDEPENDENT / len(self.weight))
        return counted * (self.likelihood - other.likelihood) - (self.price - other.price) > STRONG


def tie(fitted: Array, given: Array) -> Tie:
    """The frame that ties poses [n, 4, 4] of the same cameras together, and the offset that the given ones share.

    The errors found include those of both. An offset is believed if it explains more than its unknowns could by chance
    where errors are alike: a turn of the axes (OpenCV's for OpenGL's, a roll by 90 degrees), any turn, a shift, or
    both. None is believed with fewer than `LEAST_CAMERAS`.
    """
    poses = _Pair(np.asarray(fitted, np.float64), np.asarray(given, np.float64))
    found = poses.ties(np.eye(4))
    if len(given) < LEAST_CAMERAS:
        return found[0]
    some = np.unique(np.linspace(0, len(given) - 1, MOST_TRIED).astype(int))
    tried = _Pair(poses.fitted[some], poses.given[some])
    likeliest = np.argsort([tried.likelihood(motion_of(turn)) for turn in AXES])[::-1][:STARTS]
    for k in likeliest:
        found += poses.ties(motion_of(AXES[k]), turns=True)
    if likeliest[0] != 0:
        found += poses.ties(motion_of(AXES[likeliest[0]]), price=2 * math.log(len(AXES)))
    best = max(found, key=lambda each: each.likelihood - each.price)
    return best if best.explains_more_than(found[0]) else found[0]


@dataclass(frozen=True, eq=False)
class _Fit:
    """A frame and an offset, the errors [n, 3] that they leave, and the normal equations' matrix."""

    frame: Similarity
    cam_from_body: Array
    turned: Array
    shifted: Array
    rotation: float
    position: float
    weight: Array
    information: Array


@dataclass(frozen=True, eq=False)
class _Pair:
    """Poses [n, 4, 4] of the same cameras."""

    fitted: Array
    given: Array

    @property
    def spread(self) -> float:
        centres = self.given[:, :3, 3]
        return max(float(np.linalg.norm(centres - centres.mean(0), axis=1).mean()), 1e-300)

    def likelihood(self, cam_from_body: Array) -> float:
        """Likelihood of the errors that an offset leaves, once the rigs are aligned."""
        bodies = self.fitted @ cam_from_body
        frame = align_robust(bodies, self.given, with_rotations=True)
        turned, shifted = _apart(self.given, frame.apply_to_poses(bodies))
        return _likelihood(turned, shifted / self.spread)

    def ties(self, start: Array, *, turns: bool = False, price: float = 0.0) -> list[Tie]:
        """Ties without a shift, and with one along the axes of the body where it can be determined.

        Args:
            start: `cam_from_body` [4, 4]; its turn is refined if ``turns``.
            price: of having chosen the start.
        """
        still = self.fit(start, np.zeros((3, 0)), turns=turns)
        price += (TURN if turns else 0) * math.log(6 * len(self.given))
        moved = self.fit(still.cam_from_body, np.eye(3), turns=turns)
        axes, deviation = self._told(moved, np.eye(3))
        found = [self._tie(still, price, None, axes)]
        if 0 < axes.shape[1] < 3:
            start = moved.cam_from_body.copy()
            start[:3, 3] = start[:3, :3] @ axes @ axes.T @ start[:3, :3].T @ start[:3, 3]
            moved = self.fit(start, axes, turns=turns)
            deviation = self._told(moved, axes)[1]
        if axes.shape[1]:
            price += axes.shape[1] * math.log(6 * len(self.given))
            found.append(self._tie(moved, price, deviation, axes))
        return found

    def _told(self, fit: _Fit, axes: Array) -> tuple[Array, float]:
        """Those axes [3, k] of the body along which the shift is known, and its largest deviation."""
        others, of = np.split(np.arange(len(fit.information)), [-axes.shape[1]])
        mixed = fit.information[np.ix_(of, others)]
        rest = np.linalg.pinv(fit.information[np.ix_(others, others)], rcond=SAME**2, hermitian=True)
        values, vectors = np.linalg.eigh(fit.information[np.ix_(of, of)] - mixed @ rest @ mixed.T)
        certain = np.sqrt(np.maximum(values, 0)) / SHARED_ERRORS / self.spread
        along = axes @ vectors
        body = fit.frame.scale * fit.cam_from_body[:3, :3].T @ fit.cam_from_body[:3, 3]
        told = certain > np.minimum(
            TOLD / np.maximum(np.abs(body @ along), 1e-300), 1 / (VAGUE * self.spread)
        )
        return along[:, told], float(1 / certain[told].min()) if told.any() else math.inf

    def _tie(self, fit: _Fit, price: float, deviation: float | None, axes: Array) -> Tie:
        body_from_cam = rigid_inverse(fit.cam_from_body)
        # The offset's length is in the unit of the fitted poses; the given ones' unit is required.
        body_from_cam[:3, 3] *= fit.frame.scale
        same = np.array_equal(body_from_cam, np.eye(4))
        offset = None if same else BodyOffset(body_from_cam, deviation, axes)
        likelihood = 2 * _likelihood(fit.turned, fit.shifted / self.spread) / SHARED_ERRORS**2
        return Tie(fit.frame, offset, fit.rotation, fit.position, fit.weight, likelihood, price)

    def fit(self, cam_from_body: Array, axes: Array, *, turns: bool) -> _Fit:
        """Fit frame and offset by Gauss-Newton steps, with weights from the residuals.

        The poses that are better known are carried to the given ones, not the other way: from noisy poses a smaller
        frame with an offset would follow (regression dilution).

        Args:
            axes: [3, k] of the body, along which it may shift.
            turns: whether the offset may turn.
        """
        bodies, spread = self.fitted @ cam_from_body, self.spread
        middle = self.given[:, :3, 3].mean(0)
        frame = align_robust(bodies, self.given, with_rotations=True)
        columns = np.r_[:FRAME, FRAME : FRAME + TURN * turns, FRAME + TURN : FRAME + TURN + axes.shape[1]]
        lost = math.sqrt(6 * len(bodies) / max(6 * len(bodies) - len(columns), 1))
        for _ in range(ROUNDS):
            now = frame.apply_to_poses(bodies)
            turned, shifted = _apart(self.given, now)
            rotation, position = (
                max(float(np.median(np.linalg.norm(part, axis=1))) / MAXWELL_MEDIAN * lost, EXACT * unit)
                for part, unit in ((turned, 1.0), (shifted, spread))
            )
            deviations = np.repeat([rotation, position], 3)
            apart = np.concatenate([turned, shifted], 1)
            weight = (ROBUST / (ROBUST + ((apart / deviations) ** 2).sum(1))) ** 2
            weights = np.sqrt(weight)[:, None] / deviations
            system = weights[..., None] * _jacobian(now, middle, spread, axes)[..., columns]
            system = system.reshape(-1, len(columns))
            # The shortest solution: an offset that looks like another frame is left to the frame of the start.
            step = np.zeros(FRAME + TURN + axes.shape[1])
            step[columns] = np.linalg.lstsq(system, (weights * apart).reshape(-1), rcond=SAME)[0]
            if np.abs(system @ step[columns]).max() < SETTLED:
                break
            step *= min(1.0, FURTHEST / float(np.abs(step).max()))
            cam_from_body = cam_from_body @ motion_of(
                rotation_of(step[FRAME : FRAME + TURN]), spread * axes @ step[FRAME + TURN :] / frame.scale
            )
            bodies = self.fitted @ cam_from_body
            turn, grown = rotation_of(step[:3]), math.exp(step[6])
            moved = middle - grown * turn @ middle + spread * step[3:6]
            frame = Similarity(grown, turn, moved) @ frame
        information = np.asarray(system.T @ system)
        return _Fit(frame, cam_from_body, turned, shifted, rotation, position, weight, information)


def _apart(given: Array, now: Array) -> tuple[Array, Array]:
    """Turns and shifts [n, 3] along the world's axes that lead from poses to the given ones."""
    turn = rotation_vectors(given[:, :3, :3] @ now[:, :3, :3].transpose(0, 2, 1))
    return turn, given[:, :3, 3] - now[:, :3, 3]


def _jacobian(now: Array, middle: Array, spread: float, axes: Array) -> Array:
    """Jacobian of poses [n, 6, 10 + k] by a turn, a shift and growth of their frame, and an offset's turn and shift.

    The frame turns and grows about its middle, and lengths count in spreads of the rig.
    """
    jacobian, away = np.zeros((len(now), 6, FRAME + TURN + axes.shape[1])), now[:, :3, 3] - middle
    jacobian[:, :3, :3] = np.eye(3)
    for axis in range(3):
        jacobian[:, 3:, axis] = np.cross(np.eye(3)[axis], away)
    jacobian[:, 3:, 3:6] = spread * np.eye(3)
    jacobian[:, 3:, 6] = away
    jacobian[:, :3, FRAME : FRAME + TURN] = now[:, :3, :3]
    jacobian[:, 3:, FRAME + TURN :] = spread * now[:, :3, :3] @ axes
    return jacobian


def _likelihood(turned: Array, shifted: Array) -> float:
    """The largest logarithm of the likelihood of errors [n, 3] and [n, 3], for any deviations of the two.

    The errors of one camera are modelled as jointly Student's: a few outliers count for little.
    """
    squares = np.stack([(part**2).sum(1) for part in (turned, shifted)])
    variance = np.maximum(np.median(squares, axis=1, keepdims=True) / 3, EXACT**2)
    for _ in range(ROUNDS):
        weight = (FREEDOM + 6) / (FREEDOM + (squares / variance).sum(0))
        variance = np.maximum((weight * squares).mean(1, keepdims=True) / 3, EXACT**2)
    far = np.log1p((squares / variance).sum(0) / FREEDOM).sum()
    return float(-1.5 * squares.shape[1] * np.log(variance).sum() - (FREEDOM + 6) / 2 * far)

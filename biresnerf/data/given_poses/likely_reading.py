"""Which reading of the given poses the photos bear out: a question to the user where it is not the format's own.

A robot's flange, a gimbal or a phone's body is turned from its camera by one rotation in all photos. No reading of a
file explains such poses, but some may seem to by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.given_poses.matched_details import MatchedPair, matched_pairs, off_by
from biresnerf.data.given_poses.readings import format_of, poses_read_as
from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.rigid import motion_of, rotation_from_quat_wxyz
from biresnerf.judging.compare import BEHIND, READING, is_better
from biresnerf.options.formats import Format
from biresnerf.options.given_poses import PoseQuestion, PoseReading, in_words

Reading = tuple[PoseReading, ...]
SHIFTS = 7  # details matched wrongly on purpose show how many agree by chance
LEAST_PAIRS = 4  # of photos
TURNS = 2000  # about 15 degrees apart
DETAILS = 12  # of a pair, at most
WIDER = 4.0  # times the tolerance, so that a turn that is not quite right is noticed
# Steps of the search (rad) from the best turns, and how many are tried of each size.
STEPS, TRIES, FROM = (0.25, 0.12, 0.06, 0.03), 40, 4


def pose_question(dataset: Dataset) -> PoseQuestion | None:
    """The reading to ask about; None where the poses seem to be what their format says, or photos cannot tell.

    Raises:
        InputError: as `load_images` does.
    """
    if any(camera.panorama for camera in dataset.cameras):  # whose details lie in all directions
        return None
    return borne_out(dataset, matched_pairs(dataset))


def borne_out(dataset: Dataset, pairs: Sequence[MatchedPair]) -> PoseQuestion | None:
    """The same for known details: at the right poses they lie in front of both cameras, on one ray of each."""
    if len(pairs) < LEAST_PAIRS:
        return None
    form = format_of(dataset.source)
    rows = sorted({row for pair in pairs for row in (pair.first, pair.second)})
    given = np.stack([pose for row in rows if (pose := dataset.frames[row].world_from_cam) is not None])

    def agreeing(read: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = dict(zip(rows, read, strict=True))
        return np.array([_agreeing(poses[pair.first], poses[pair.second], pair) for pair in pairs])

    as_given = agreeing(given)
    others = {one: agreeing(poses_read_as(given, dataset.source, one)) for one in _readings(form)}
    best = max(others.values(), key=lambda found: float(found.mean()))
    if not is_better(best - as_given, READING):
        return None
    of_body = agreeing(given @ motion_of(best_turn(dict(zip(rows, given, strict=True)), pairs)))
    if is_better(of_body - best, READING):
        return None  # poses of what carries the camera, as the run will find
    reading = next(one for one, found in others.items() if not is_better(best - found, BEHIND))
    shares = float(as_given.mean()), float(others[reading].mean())
    return PoseQuestion(given_poses=reading, question=_asked(reading, shares), agreeing=shares)


def _readings(form: Format) -> Iterator[Reading]:
    """Other readings of poses in this format, those of commoner mistakes first."""
    axes: PoseReading = "opengl_axes" if form.axes == "opencv" else "opencv_axes"
    yield from ((axes,), ("inverted",), ("inverted", axes), ("transposed",), ("transposed", axes))
    if form.quaternion:
        yield ("wxyz" if form.quaternion == "xyzw" else "xyzw",)
    yield from (("left_handed",), ("rolled_90",), ("rolled_180",), ("rolled_270",))


def _agreeing(first: NDArray[np.float64], second: NDArray[np.float64], pair: MatchedPair) -> float:
    """The share of a pair's details that its poses [4, 4] explain, beyond what they would by chance.

    Those within the tolerance count the more the nearer they are.
    """
    count = len(pair.in_first)
    shifts = range(min(SHIFTS + 1, count))
    rows = np.concatenate([np.roll(np.arange(count), shift) for shift in shifts])
    off = off_by(first, second, np.tile(pair.in_first, (len(shifts), 1)), pair.in_second[rows])
    agree = np.clip(1.0 - off / pair.tolerance, 0.0, 1.0).reshape(len(shifts), count).mean(axis=1)
    return float(agree[0] - agree[1:].mean())


def _asked(reading: Sequence[PoseReading], shares: tuple[float, float]) -> str:
    before, after = (f"{100 * max(share, 0.0):.0f} %" for share in shares)
    return (
        f"The given poses seem to {in_words(reading)}: {after} of what photos have in common fits them so, "
        f"{before} fits them as their format has it."
    )


def as_warning(question: PoseQuestion) -> str:
    """The question as a warning, with the option that answers yes, for users who cannot be asked."""
    return f"{question.question} If so, set given_poses={','.join(question.given_poses)}"


def best_turn(world_from_body: Mapping[int, Array], pairs: Sequence[MatchedPair]) -> Array:
    """The body_from_cam [3, 3] that fits most of the details that pairs of photos share.

    Args:
        world_from_body: poses [4, 4] by the rows that pairs name.
    """
    score, rng = _scorer(world_from_body, pairs), np.random.default_rng(0)
    turns = rotation_from_quat_wxyz(rng.normal(size=(TURNS, 4)))
    scores = np.array([score(turn, WIDER) for turn in turns])
    found: list[tuple[float, Array]] = []
    for index in np.argsort(-scores)[:FROM]:
        turn, wide = turns[index], WIDER
        for size in STEPS:
            near = turn @ rotation_from_quat_wxyz(
                np.column_stack([np.ones(TRIES), rng.normal(size=(TRIES, 3)) * size / 2])
            )
            near = np.concatenate([turn[None], near])
            turn = near[np.argmax([score(each, wide) for each in near])]
            wide = max(wide / 2, 1.0)
        found.append((score(turn, 1.0), turn))
    return max(found, key=lambda each: each[0])[1]


def _scorer(
    world_from_body: Mapping[int, Array], pairs: Sequence[MatchedPair]
) -> Callable[[Array, float], float]:
    """How many details fit beyond those that would by chance, for a turn and a width of the tolerance."""
    few = [slice(None, None, -(-len(pair.in_first) // DETAILS)) for pair in pairs]
    counts = [len(pair.in_first[part]) for pair, part in zip(pairs, few, strict=True)]
    first, second = (
        np.repeat([world_from_body[row] for row in rows], counts, axis=0)
        for rows in ([pair.first for pair in pairs], [pair.second for pair in pairs])
    )
    tolerance = np.repeat([pair.tolerance for pair in pairs], counts)
    in_first = np.concatenate([pair.in_first[part] for pair, part in zip(pairs, few, strict=True)])
    rights, wrongs = (
        np.concatenate(
            [np.roll(pair.in_second[part], shift, axis=0) for pair, part in zip(pairs, few, strict=True)]
        )
        for shift in (0, DETAILS // 3)
    )

    def score(turn: Array, wide: float) -> float:
        shares = [
            np.clip(
                1 - off_by(first, second, in_first @ turn.T, seen @ turn.T) / (wide * tolerance), 0, 1
            ).mean()
            for seen in (rights, wrongs)
        ]
        return float(shares[0] - shares[1])

    return score

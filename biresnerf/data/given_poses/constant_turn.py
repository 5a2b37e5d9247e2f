"""The turn between cameras and the poses given for them, where these are of what carries the camera.

A robot's flange, a gimbal or a phone's body is turned from its camera by one rotation in all photos. No reading of a
file explains such poses, but some may seem to by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from biresnerf.arrays import Array
from biresnerf.data.given_poses.matched_details import MatchedPair, off_by
from biresnerf.geometry.rigid import rotation_from_quat_wxyz

TURNS = 2000  # about 15 degrees apart
DETAILS = 12  # of a pair, at most
WIDER = 4.0  # times the tolerance, so that a turn that is not quite right is noticed
# Steps of the search (rad) from the best turns, and how many are tried of each size.
STEPS, TRIES, FROM = (0.25, 0.12, 0.06, 0.03), 40, 4


def best_turn(world_from_body: Mapping[int, Array], pairs: Sequence[MatchedPair]) -> Array:
    """body_from_cam [3, 3], by which most of what pairs of photos have in common fits.

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

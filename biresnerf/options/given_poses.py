"""What a file's poses may mean instead of what its format says; `biresnerf.data.given_poses` reads them so."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from biresnerf.frozen_model import FrozenModel

PoseReading = Literal[
    "inverted", "transposed", "opencv_axes", "opengl_axes", "wxyz", "xyzw", "left_handed", "rolled_90", "rolled_180",
    "rolled_270",
]  # fmt: skip
# Which of them say the same thing in different ways.
EITHER: tuple[frozenset[PoseReading], ...] = (
    frozenset({"opencv_axes", "opengl_axes", "left_handed"}),
    frozenset({"wxyz", "xyzw"}),
    frozenset({"rolled_90", "rolled_180", "rolled_270"}),
)
WORDS: dict[PoseReading, str] = {
    "inverted": "be inverted (world to camera where camera to world is meant, or the reverse)",
    "transposed": "be transposed (rotations by columns where rows are meant)",
    "opencv_axes": "have OpenCV's axes (y down, z forward)",
    "opengl_axes": "have OpenGL's axes (y up, z backward)",
    "wxyz": "have the scalar of quaternions first",
    "xyzw": "have the scalar of quaternions last",
    "left_handed": "be left-handed (y up, z forward, as in Unity)",
    "rolled_90": "be those of photos before they were turned by 90 degrees clockwise",
    "rolled_180": "be those of photos before they were turned upside down",
    "rolled_270": "be those of photos before they were turned by 90 degrees counterclockwise",
}


class PoseQuestion(FrozenModel):
    """A question to the user: the given poses seem to mean something else than their format says."""

    given_poses: tuple[PoseReading, ...] = Field(
        examples=[["opencv_axes"]], description="The value of the option `given_poses` that reads them so."
    )
    question: str = Field(examples=["The given poses look inverted."])
    agreeing: tuple[float, float] = Field(
        examples=[[0.01, 0.62]],
        description="Share of what photos have in common that fits the poses, beyond chance: as given, and read so.",
    )


def in_words(reading: Sequence[PoseReading]) -> str:
    """What poses that mean ``reading`` seem to ..., for a sentence."""
    return " and to ".join(WORDS[one] for one in reading)


def refuse_contradictions(reading: Sequence[PoseReading]) -> Sequence[PoseReading]:
    """Returns ``reading``; raises ValueError for two that contradict each other."""
    for group in EITHER:
        both = [one for one in reading if one in group]
        if len(both) > 1:
            raise ValueError(f"cannot be both {both[0]} and {both[1]}")
    return reading

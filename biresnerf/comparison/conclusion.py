"""What a comparison of two results says: a conclusion in words, and what it rests on."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from biresnerf.frozen_model import FrozenModel

Outcome = Literal["first", "second", "same", "unknown"]
Side = Literal["first", "second", "same", "open"]


class ComparedFigure(FrozenModel):
    """A figure or an option of which the two results have different values."""

    name: str = Field(examples=["Fit of feature matches"])
    first: str = Field(examples=["0.39 px"])
    second: str = Field(examples=["7.04 px"])
    better: Side | None = Field(
        None,
        examples=["first"],
        description="Which result it speaks for: same where the difference is too small to matter, open where it "
        "is too uncertain to tell; None where it says nothing of the poses.",
    )
    note: str = Field("", description="Why it tells nothing, where that needs a word.")


class PoseDifference(FrozenModel):
    """How the pose of one photo differs between two results, once these are aligned."""

    name: str = Field(examples=["images/0001.jpg"])
    turned_deg: float = Field(examples=[0.31])
    moved: float = Field(examples=[0.004], description="Of the centre, in units of the first result.")
    contradicts: bool = Field(
        False,
        description="It differs by more than three times what both results state of its accuracy, or where they state "
        "none, by more than 5 degrees.",
    )


class Comparison(FrozenModel):
    """Which of two results has the better poses, and why that is said."""

    outcome: Outcome = Field(
        description="first or second: that result is better; same: their poses do not differ by more than their "
        "accuracy, and nothing tells them apart; unknown: it cannot be known."
    )
    contradict: bool = Field(
        description="Most poses differ by far more than the results state of their accuracy: at most one is right."
    )
    conclusion: str = Field(
        examples=["The first result is better by fit of feature matches."], description="In words."
    )
    why: tuple[str, ...] = Field(
        examples=[["Fit of feature matches: 0.39 px and 7.04 px."]],
        description="The grounds in sentences, the weightiest first.",
    )
    photos: int = Field(examples=[32], description="How many photos both results hold.")
    figures: tuple[ComparedFigure, ...] = Field(description="Measures, figures and options that differ.")
    poses: tuple[PoseDifference, ...] = Field(
        description="Of the photos that both hold; the largest turn first."
    )

"""Whether refinement helped, in figures and words. No torch: the service reads it too."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from biresnerf.frozen_model import FrozenModel

VerdictName = Literal["improved", "unchanged", "kept_input", "inconclusive", "failed_check"]
Finding = Literal["better", "worse", "same", "open"]
_VERDICT_WORDS: dict[VerdictName, str] = {
    "improved": "improved",
    "unchanged": "unchanged",
    "kept_input": "not improved",
    "inconclusive": "inconclusive",
    "failed_check": "check failed",
}
_POSES_BEFORE = {
    "given": "your own poses",
    "seeded": "the poses from feature matches",
    "mixed": "the poses it started from",
}


class PairedDifference(FrozenModel):
    """One figure for the input's poses and for the refined ones, taken of the same views or images.

    `difference` is the mean over them of how much better the refined poses are: positive is better, whatever the
    figure. The interval is Student's, at 95 %.
    """

    count: int = Field(examples=[18], description="Views or images that the figure was taken of.")
    before: float = Field(examples=[21.4], description="With the input's poses: the mean.")
    after: float = Field(examples=[24.9], description="With the refined poses: the mean.")
    difference: float = Field(examples=[3.5])
    low: float | None = Field(
        None, examples=[2.9], description="Lower end of the interval; None of fewer than two."
    )
    high: float | None = Field(None, examples=[4.1])
    finding: Finding = Field(
        description="better, worse, same (the interval holds nothing that would matter), or open (it holds too much)."
    )


class HeldOutEvidence(FrozenModel):
    """Two equal short trainings on poses held still, the input's and the refined ones, scored on unseen views."""

    protocol: Literal["frozen_retraining"] = "frozen_retraining"
    steps: int = Field(examples=[1000], description="Of each of the two trainings.")
    strictly: int = Field(
        examples=[6],
        description="Of the views: those that the refinement never trained its field on, either.",
    )
    psnr: PairedDifference = Field(description="dB.")
    ssim: PairedDifference


class EpipolarEvidence(FrozenModel):
    """How well matched features fit the poses: each image's median symmetric epipolar error.

    The difference is the mean of log2(before / after) over images: 1 is half the error.
    """

    matches: int = Field(examples=[48_210])
    independent: bool = Field(
        description="Whether the start had nothing to do with these matches. If it had, they may speak against the "
        "refined poses, not for them."
    )
    error_px: PairedDifference = Field(
        description="Pixels of the full-size photos; before and after are medians."
    )
    share_of_image: float = Field(
        examples=[0.0004], description="The error after, as a share of the photos' long side."
    )


class Verdict(FrozenModel):
    """Whether the refined poses are better than the input's, and why that is said."""

    verdict: VerdictName
    returned: Literal["refined", "input"] = Field(
        description="Whose poses the result holds. Where it is the input's, refined/ holds the refined ones."
    )
    compared_with: Literal["given", "seeded", "mixed"] = Field(
        description="The input's poses: all the user's own, all found by us, or some of each."
    )
    why: tuple[str, ...] = Field(
        examples=[["Unseen views are predicted 3.50 dB better (95 %: 2.90 to 4.10)."]],
        description="The grounds in sentences, the weightiest first.",
    )
    moved_px: float = Field(
        examples=[4.2],
        description="How far the scene's middle moves in the image from the input's to the refined poses: median over "
        "cameras, px at working size.",
    )
    heldout: HeldOutEvidence | None = None
    epipolar: EpipolarEvidence | None = None

    def in_words(self) -> list[str]:
        """The verdict in one sentence, whose poses the result holds, and a line for each proof."""
        ground, *proofs = self.why
        return [
            f"{_VERDICT_WORDS[self.verdict]}: {ground} The result contains {self._returned_poses()}.",
            *(f"  {p}" for p in proofs),
        ]

    def _returned_poses(self) -> str:
        if self.returned == "refined":
            return "the refined poses"
        return f"{_POSES_BEFORE[self.compared_with]}; the refined ones are in refined/"

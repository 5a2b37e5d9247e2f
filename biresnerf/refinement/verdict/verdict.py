"""The decision: are the refined poses better than the input's? Fixed rules; ties go to the input.

docs/verdict.md explains them. Every comparison is paired and signed, positive where the refined poses are better, so
that swapping the two sets of poses flips every finding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from biresnerf.arrays import Array
from biresnerf.judging.compare import FITS_BELOW
from biresnerf.refinement.numbers.choosing import VerdictNumbers
from biresnerf.refinement.views.compare_rigs import photos_tell
from biresnerf.report import (
    EpipolarEvidence,
    Finding,
    HeldOutEvidence,
    PairedDifference,
    Verdict,
    VerdictName,
)

VIEWS, MATCHES, POSITIONS = "unseen views", "feature matches", "measured positions"


@dataclass(frozen=True)
class Findings:
    """All that the decision is based on.

    Attributes:
        failed: sentences on what is inconsistent; empty where all is well.
        moved_px: how far the image moved, at working size.
        faults: sentences on what failed on our side.
        working_share: working size over the full size that `epipolar` is measured at.
        out_of_frame: a sentence if the refined poses fit the input's frame only roughly, else empty.
        turned_far: whether the median camera ends turned by more than `far_deg`.
        compared_with: where the input's poses come from.
        grounded: whether the input's poses are given ones or come from matches, and are not mere guesses.
        offset: whether an offset that all given poses shared was taken back.
        by_gimbal: whether most of the input's poses are those of GPS and a gimbal.
        determined: the share of cameras whose refined poses feature matches and photos determine; None if not known.
        by_positions: what measured places say of the refined poses: same where they fit both alike and their accuracy
            is stated; None where it is not.
        may_be_blur: whether a gain of unseen views may be blur, and there was no time to see whether it stands.
    """

    failed: tuple[str, ...]
    moved_px: float
    heldout: HeldOutEvidence | None
    epipolar: EpipolarEvidence | None
    compared_with: Literal["given", "seeded", "mixed"]
    grounded: bool
    out_of_frame: str = ""
    turned_far: bool = False
    faults: tuple[str, ...] = ()
    working_share: float = 1.0
    offset: bool = False
    by_positions: Finding | None = None
    by_gimbal: bool = False
    determined: float | None = None
    may_be_blur: bool = False
    numbers: VerdictNumbers = VerdictNumbers()

    @property
    def explained(self) -> bool:
        """Whether the matches' error fell by enough to show that such a motion is right."""
        if self.epipolar is None:
            return False
        error = self.epipolar.error_px
        lost_px = (error.before - error.after) * self.working_share
        return self.numbers.explained * (self.moved_px - self.numbers.unexplained_px) < lost_px

    @property
    def by_matches(self) -> Finding:
        """What feature matches may say of the refined poses: they support them only where they explain the motion."""
        if self.epipolar is not None and self.epipolar.error_px.finding == "worse":
            return "worse"
        better = matches_are_better(self) and self.explained and not self.undetermined
        return "better" if better else "open"

    @property
    def undetermined(self) -> bool:
        """Whether the evidence leaves most refined poses open: it may fit wrong ones as well."""
        return self.determined is not None and self.determined < self.numbers.mostly


def failed_checks(refined: Array, lost: int, numbers: VerdictNumbers) -> tuple[str, ...]:
    """Sentences on what is inconsistent about refined poses [n, 4, 4]; `lost` cameras have no fitting pose."""
    if not np.isfinite(refined).all():
        return ("Refined poses are not finite.",)
    if lost > numbers.mostly * len(refined):
        return (f"{lost} of {len(refined)} cameras are lost: they agree with no pose that was found.",)
    return ()


def frame_doubt(turned_deg: Array, shifted: Array, spread: float, numbers: VerdictNumbers) -> str:
    """A sentence if refined poses end so far from the input's that its frame and scale are known only roughly.

    Args:
        turned_deg, shifted: how far each camera ends from its input pose, in the input's frame.
        spread: root-mean-square distance of the input's centres from their mean.
    """
    turn, shift = float(np.median(turned_deg)), float(np.median(shifted))
    if not (turn > numbers.far_deg or shift > numbers.far_share * spread > 0):
        return ""
    return (
        f"The refined poses fit the input's frame and scale only roughly: half of them are {turn:.3g} deg and "
        f"{shift:.3g} units (the cameras' spread is {spread:.3g}) or more from the input's."
    )


def decide(findings: Findings) -> Verdict:
    """The verdict by the rules of docs/verdict.md."""
    name, ground = _judge(findings)
    # Where nothing supports either, given poses stay, as do found ones while the evidence is weak. Mere guesses yield,
    # and so do found ones that measure the same, as left-out tracks and patches chose the refined ones. Found ones also
    # yield where left-out matches fit the refined ones better, or where these alone use measured places, and nothing
    # contradicts them.
    yields = _measures_the_same(findings) if name == "unchanged" else not findings.grounded
    yields = yields or _found_poses_yield(findings)
    keep = name != "improved" and not (name in ("unchanged", "inconclusive") and yields)
    return Verdict(
        verdict=name,
        returned="input" if keep else "refined",
        compared_with=findings.compared_with,
        why=(ground, *(fault for fault in findings.faults if fault not in ground), *_sentences(findings)),
        moved_px=findings.moved_px,
        heldout=findings.heldout,
        epipolar=findings.epipolar,
    )


def _judge(f: Findings) -> tuple[VerdictName, str]:
    if f.failed:
        return "failed_check", " ".join(f.failed)
    if f.moved_px < f.numbers.measurable_px:
        least = f.numbers.measurable_px
        return "unchanged", f"The poses moved by less than can be measured (below {least:g} px)."
    speaks_for, speaks_against = _who_say(f, "better"), _who_say(f, "worse")
    # Positions may be off by more than a narrow rig is wide. Rotations that far off are another arrangement.
    needed = {VIEWS, MATCHES} if f.turned_far else {MATCHES}
    if f.out_of_frame and (speaks_against or not needed <= set(speaks_for)):
        return "failed_check", f.out_of_frame
    if speaks_for and speaks_against:
        return (
            "inconclusive",
            f"The evidence disagrees: {_named(speaks_for)} for the refined poses, {_named(speaks_against)} against.",
        )
    if speaks_against:
        return "kept_input", f"The refined poses are worse by {_named(speaks_against)}."
    if f.epipolar is not None and f.epipolar.share_of_image > FITS_BELOW:
        return (
            "inconclusive",
            "Neither the input's poses nor the refined ones agree with the feature matches.",
        )
    if f.faults:
        return "inconclusive", " ".join(f.faults)
    if speaks_for:
        unknown = (
            "How far they are off is not known: the evidence leaves most of them open."
            if f.undetermined
            else ""
        )
        return "improved", " ".join(
            filter(None, (f"The refined poses are better by {_named(speaks_for)}.", unknown, f.out_of_frame))
        )
    return _without_a_voice(f)


def _without_a_voice(f: Findings) -> tuple[VerdictName, str]:
    """The finding where no evidence counts, for or against."""
    if matches_are_better(f) and f.undetermined:
        return (
            "inconclusive",
            "Feature matches fit the refined poses better, but do not determine the poses of most photos.",
        )
    if matches_are_better(f):
        return (
            "inconclusive",
            "Feature matches fit the refined poses better, but by too little for poses that moved by "
            f"{f.moved_px:.3g} px.",
        )
    if _views_are_better(f) and f.heldout is not None:
        return (
            "inconclusive",
            "Unseen views fit the refined poses better, but these still miss the photos by about "
            f"{f.heldout.missed_px:.2g} px, too much to tell poses that moved by {f.moved_px:.2g} px.",
        )
    findings = [item.finding for item in _counted(f)]
    if findings and all(finding == "same" for finding in findings):
        if _measures_the_same(f):
            return "unchanged", "No measure tells the refined poses from those that feature matches gave."
        return "kept_input", "The refined poses are no better than the input's by any measure."
    return "inconclusive", "The evidence is too weak to tell the refined poses from the input's."


def _measures_the_same(f: Findings) -> bool:
    """Whether poses that matches gave and refined ones differ, and neither unseen views nor other matches tell how."""
    counted = _counted(f)
    both = len(counted) == 2 and all(item.finding == "same" for item in counted)
    return f.compared_with == "seeded" and f.moved_px >= f.numbers.measurable_px and both


def _found_poses_yield(f: Findings) -> bool:
    """Whether poses that matches gave yield to refined ones, which nothing contradicts.

    They do where the refined ones alone use measured places, or fit left-out matches better.
    """
    if f.compared_with != "seeded" or f.faults or _who_say(f, "worse"):
        return False
    heeded = f.by_positions is not None and f.moved_px >= f.numbers.measurable_px
    fits = f.epipolar is not None and f.epipolar.share_of_image <= FITS_BELOW
    return heeded or (fits and matches_are_better(f))


def _counted(f: Findings) -> list[PairedDifference]:
    """The comparisons that may support the refined poses."""
    counted = [f.heldout.psnr] if f.heldout is not None else []
    if f.epipolar is not None and f.epipolar.independent:
        counted.append(f.epipolar.error_px)
    return counted


def _who_say(f: Findings, finding: Finding) -> list[str]:
    """The evidence that the refined poses are better, or worse; matches that gave the start only count for worse."""
    if finding == "better":
        views = _views_are_better(f) and (_views_tell(f) or (matches_are_better(f) and not f.undetermined))
    else:
        views = f.heldout is not None and "worse" in (f.heldout.psnr.finding, f.heldout.ssim.finding)
        views = views and (_views_tell(f) or f.by_matches != "better")
    said = {VIEWS: views, MATCHES: f.by_matches == finding, POSITIONS: f.by_positions == finding}
    return [name for name, says in said.items() if says]


def _views_are_better(f: Findings) -> bool:
    return f.heldout is not None and f.heldout.psnr.finding == "better"


def _views_tell(f: Findings) -> bool:
    """Whether unseen views may decide alone, or against matches: poses that fit photos better may miss them by far."""
    missed = f.heldout.missed_px if f.heldout is not None else None
    return missed is None or (photos_tell(missed, f.moved_px, f.numbers) and not f.may_be_blur)


def matches_are_better(f: Findings) -> bool:
    """Whether independent matches fit the refined poses better, whatever that shows."""
    return f.epipolar is not None and f.epipolar.independent and f.epipolar.error_px.finding == "better"


def _named(evidence: list[str]) -> str:
    return " and ".join(evidence)


def _sentences(f: Findings) -> list[str]:
    """The figures, in words."""
    sentences = []
    before = "the poses found" if f.compared_with == "seeded" else "the input's poses"
    if f.offset:
        sentences.append(
            "The input's poses are those of the cameras: an offset that all shared was taken back."
        )
    if f.by_gimbal:
        sentences.append(
            "The poses found are those of GPS and the drone's gimbal: how far they are off is not known, as no feature "
            "matches tell."
        )
    if f.heldout is not None:
        p = f.heldout.psnr
        sentences.append(
            f"{p.count} unseen views: {p.before:.2f} dB with {before}, {p.after:.2f} dB with the refined ones"
            f" ({_gain_db(p)})."
        )
    if f.epipolar is not None:
        e = f.epipolar.error_px
        source = "" if f.epipolar.independent else ", which the initial poses came from"
        sentences.append(
            f"{f.epipolar.matches} feature matches{source}: epipolar error {e.before:.2f} px with {before}, "
            f"{e.after:.2f} px with the refined ones ({_times(e)})."
        )
    return sentences


def _gain_db(item: PairedDifference) -> str:
    if item.low is None or item.high is None:
        return f"{item.difference:+.2f} dB"
    return f"{item.difference:+.2f} dB, 95 % interval {item.low:+.2f} to {item.high:+.2f}"


def _times(item: PairedDifference) -> str:
    """A ratio of errors given as its logarithm to base 2."""
    ratio = f"{2 ** abs(item.difference):.2g}"
    words = f"typically {ratio} times {'larger' if item.difference < 0 else 'smaller'}"
    if ratio == "1":
        words = "typically the same"
    if item.low is None or item.high is None:
        return words
    return f"{words}, 95 % interval of before / after {2**item.low:.2g} to {2**item.high:.2g}"

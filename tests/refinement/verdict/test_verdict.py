"""The decision: fixed rules, symmetric in the two sets of poses, and the input has the benefit of the doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.judging.compare import FITS_BELOW, MATCH_ERRORS, UNSEEN_PSNR, UNSEEN_SSIM, paired
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.verdict.verdict import (
    Findings,
    decide,
    failed_checks,
    frame_doubt,
)
from biresnerf.report import EpipolarEvidence, HeldOutEvidence


def held_out(
    gain: float,
    spread: float = 0.2,
    views: int = 8,
    *,
    similarity_gain: float | None = None,
    missed_px: float | None = 1.0,
) -> HeldOutEvidence:
    """Evidence of views that gain so much (dB), plus and minus the spread; SSIM a hundredth of it where left out."""
    before = np.linspace(20, 25, views)
    gains = gain + spread * np.resize([1.0, -1.0], views)
    similarity, changes = np.full(views, 0.8), 0.01 * gains
    if similarity_gain is not None:
        changes = changes - changes.mean() + similarity_gain
    return HeldOutEvidence(
        steps=200,
        strictly=views,
        psnr=paired(before, before + gains, UNSEEN_PSNR),
        ssim=paired(similarity, similarity + changes, UNSEEN_SSIM),
        missed_px=missed_px,
    )


def matched(octaves: float, *, independent: bool = True, share: float = 0.001) -> EpipolarEvidence:
    """Evidence of images whose error halves so many times."""
    gains = octaves + 0.05 * np.resize([1.0, -1.0], 10)
    before = np.full(10, 2.0)
    return EpipolarEvidence(
        matches=1000,
        independent=independent,
        error_px=paired(before, before / 2**gains, MATCH_ERRORS, gains),
        share_of_image=share,
    )


def findings(
    heldout: HeldOutEvidence | None = None, epipolar: EpipolarEvidence | None = None, **changed
) -> Findings:
    told = Findings(
        failed=(), moved_px=3.0, heldout=heldout, epipolar=epipolar, compared_with="given", grounded=True
    )
    return replace(told, **changed)


@pytest.mark.parametrize(
    ("told", "verdict", "returned"),
    [
        (findings(held_out(4.0)), "improved", "refined"),
        (findings(held_out(4.0), matched(1.0)), "improved", "refined"),
        (findings(held_out(0.05), matched(1.0)), "improved", "refined"),
        (findings(held_out(-4.0)), "kept_input", "input"),
        (findings(held_out(-4.0), matched(-1.0)), "kept_input", "input"),
        (findings(held_out(0.05)), "kept_input", "input"),
        (findings(held_out(0.05), matched(0.0)), "kept_input", "input"),
        (findings(held_out(0.05), matched(-1.0)), "kept_input", "input"),
        (findings(held_out(4.0), matched(-1.0)), "inconclusive", "input"),
        (findings(held_out(-4.0), matched(1.0)), "inconclusive", "input"),
        (findings(held_out(1.0, spread=3.0)), "inconclusive", "input"),
        (findings(held_out(0.05, similarity_gain=-0.05)), "kept_input", "input"),
        (findings(held_out(4.0, similarity_gain=-0.05)), "inconclusive", "input"),
        (findings(held_out(0.05), by_positions="better"), "improved", "refined"),
        (findings(held_out(4.0), by_positions="worse"), "inconclusive", "input"),
        (findings(held_out(0.05, similarity_gain=0.05)), "kept_input", "input"),
        (findings(held_out(4.0, views=1)), "inconclusive", "input"),
        (findings(), "inconclusive", "input"),
        (findings(held_out(4.0), moved_px=BIRESNERF.verdict.measurable_px / 2), "unchanged", "input"),
        (findings(held_out(4.0), failed=("Gone.",)), "failed_check", "input"),
        (findings(held_out(4.0), matched(1.0), out_of_frame="Far."), "improved", "refined"),
        (findings(held_out(4.0), out_of_frame="Far."), "failed_check", "input"),
        (findings(held_out(0.05), matched(1.0), out_of_frame="Far."), "improved", "refined"),
        (findings(held_out(0.05), matched(1.0), out_of_frame="Far.", moved_px=30.0), "failed_check", "input"),
        (findings(held_out(-4.0), matched(1.0), out_of_frame="Far."), "failed_check", "input"),
        (findings(held_out(4.0), matched(1.0), out_of_frame="Far.", turned_far=True), "improved", "refined"),
        (
            findings(held_out(0.05), matched(1.0), out_of_frame="Far.", turned_far=True),
            "failed_check",
            "input",
        ),
        (findings(held_out(4.0), matched(-1.0), out_of_frame="Far."), "failed_check", "input"),
        (findings(held_out(4.0), matched(1.0, share=2 * FITS_BELOW)), "inconclusive", "input"),
        (findings(held_out(4.0), faults=("COLMAP failed.",)), "inconclusive", "input"),
        (findings(held_out(-4.0), faults=("COLMAP failed.",)), "kept_input", "input"),
    ],
)
def test_the_verdict_follows_from_the_evidence(told, verdict, returned):
    decided = decide(told)
    assert (decided.verdict, decided.returned) == (verdict, returned)
    assert decided.why


@pytest.mark.parametrize("gain", [4.0, 0.05, -4.0])
def test_a_fault_of_ours_is_named_whatever_the_verdict(gain):
    assert "COLMAP failed." in " ".join(decide(findings(held_out(gain), faults=("COLMAP failed.",))).why)


def test_matches_that_made_the_start_speak_against_refined_poses_but_not_for_them():
    assert decide(findings(epipolar=matched(1.0, independent=False))).verdict == "inconclusive"
    assert decide(findings(held_out(0.05), matched(1.0, independent=False))).verdict == "kept_input"
    assert decide(findings(held_out(4.0), matched(-1.0, independent=False))).verdict == "inconclusive"
    assert decide(findings(epipolar=matched(-1.0, independent=False))).verdict == "kept_input"


def test_matches_that_gain_little_do_not_speak_for_poses_that_moved_far():
    """They lose 1 px: a tenth of 11 px, but for one that is free."""
    moved_far, fairly, a_little = ({"moved_px": moved} for moved in (11.5, 10.5, 0.9))
    assert decide(findings(held_out(0.05), matched(1.0), **moved_far)).verdict == "inconclusive"
    assert decide(findings(held_out(0.05), matched(1.0), **fairly)).verdict == "improved"
    assert decide(findings(held_out(4.0), matched(1.0), **moved_far)).verdict == "improved"
    assert decide(findings(held_out(0.05), matched(0.11), **a_little)).verdict == "improved"
    # At half the size a px of the matches is half a px of the motion.
    assert decide(findings(epipolar=matched(1.0), working_share=0.5, **fairly)).verdict == "inconclusive"


def test_photos_alone_do_not_speak_for_poses_that_miss_them_by_more_than_half_of_the_motion():
    """Poses that explain each other fit photos better than the input's, and may be as far from the truth."""
    far, near = held_out(0.7, missed_px=6.0), held_out(0.7, missed_px=4.0)
    assert decide(findings(far, moved_px=2.2)).verdict == "inconclusive"
    assert "miss the photos by about 6 px" in decide(findings(far, moved_px=2.2)).why[0]
    assert decide(findings(far, moved_px=10.0)).verdict == "inconclusive"
    assert decide(findings(near, moved_px=10.0)).verdict == "improved"
    # A short training's blur is no sign of wrong poses.
    assert decide(findings(held_out(0.7, missed_px=1.9), moved_px=0.5)).verdict == "improved"
    # Nor are they alone where matches fit better, too, if by too little to say so by themselves.
    assert decide(findings(far, matched(1.0), moved_px=11.5)).verdict == "improved"
    assert decide(findings(held_out(-0.7, missed_px=6.0), moved_px=2.2)).verdict == "kept_input"


def test_matches_that_leave_most_poses_open_speak_for_none():
    matches = findings(held_out(0.05), matched(1.0), determined=0.4)
    blurred = replace(matches, heldout=held_out(0.7, missed_px=6.0))
    assert [decide(each).verdict for each in (matches, blurred)] == ["inconclusive", "inconclusive"]
    for share in (0.5, None):
        assert decide(replace(matches, determined=share)).verdict == "improved"
        assert decide(replace(blurred, determined=share, moved_px=11.5)).verdict == "improved"
    # Photos that are near their renders need no matches, and found poses yield as before.
    near = replace(matches, heldout=held_out(4.0))
    assert decide(near).verdict == "improved"
    assert "is not known" in decide(near).why[0]
    assert "is not known" not in decide(replace(near, determined=0.5)).why[0]
    assert decide(replace(matches, compared_with="seeded")).returned == "refined"
    assert decide(replace(matches, epipolar=matched(-1.0))).verdict == "kept_input"


def test_poses_that_nobody_gave_yield_to_refined_ones_that_measure_the_same():
    """As those with a principal point that was found: all cameras turn, which neither photos nor matches can tell."""
    same = findings(held_out(0.1, spread=0.05), matched(0.0))
    assert (decide(same).verdict, decide(same).returned) == ("kept_input", "input")
    seeded = decide(replace(same, compared_with="seeded"))
    assert (seeded.verdict, seeded.returned) == ("unchanged", "refined")
    for worse in (held_out(-4.0), held_out(0.1, spread=3.0)):
        assert decide(findings(worse, matched(0.0), compared_with="seeded")).returned == "input"
    alone = findings(held_out(0.1, spread=0.05), compared_with="seeded")
    assert decide(alone).returned == "input"


def test_found_poses_yield_to_refined_ones_that_heed_measured_places():
    weak = findings(held_out(1.0, spread=3.0), compared_with="seeded")
    heeding = replace(weak, by_positions="same")
    assert [decide(each).returned for each in (weak, heeding)] == ["input", "refined"]
    assert decide(heeding).verdict == "inconclusive"
    for doubt in ({"compared_with": "given"}, {"faults": ("a fault",)}, {"by_positions": "worse"}):
        assert decide(replace(heeding, **doubt)).returned == "input"


def test_views_that_miss_the_photos_by_far_do_not_overrule_matches():
    # An object that was turned before a still room: wrong poses that explain the room fit photos better, and none well.
    far, near = (findings(held_out(-2.3, missed_px=px), matched(7.9), moved_px=10.9) for px in (16.0, 5.0))
    assert [decide(each).verdict for each in (far, near)] == ["improved", "inconclusive"]
    alone = replace(far, epipolar=None)
    disagreeing = replace(far, epipolar=matched(-1.0))
    assert [decide(each).verdict for each in (alone, disagreeing)] == ["kept_input", "kept_input"]


def test_found_poses_yield_to_refined_ones_that_left_out_matches_fit_better():
    unexplained = findings(held_out(0.05), matched(0.3), moved_px=200.0, compared_with="seeded")
    said = decide(unexplained)
    assert (said.verdict, said.returned) == ("inconclusive", "refined")
    off = matched(0.3, share=0.5)
    doubts = (
        {"compared_with": "given"},
        {"faults": ("a fault",)},
        {"heldout": held_out(-4.0)},
        {"epipolar": off},
    )
    for doubt in doubts:
        assert decide(replace(unexplained, **doubt)).returned == "input"


def test_measured_poses_are_called_what_they_are():
    told = decide(findings(held_out(0.05), compared_with="seeded", by_gimbal=True))
    assert told.returned == "input"
    assert any("GPS and the drone's gimbal" in sentence for sentence in told.why)


def test_without_evidence_refined_poses_stand_only_against_a_guess():
    assert decide(findings(grounded=False)).returned == "refined"
    assert decide(findings(held_out(-4.0), grounded=False)).returned == "input"


def test_what_improves_one_way_is_kept_the_other_way():
    for gain in (0.6, 1.0, 3.0):
        assert decide(findings(held_out(gain))).verdict == "improved"
        assert decide(findings(held_out(-gain))).verdict == "kept_input"


def test_what_is_inconsistent_fails_the_check():
    poses = np.tile(np.eye(4), (6, 1, 1))
    assert failed_checks(poses, 3, BIRESNERF.verdict) == ()
    broken = poses.copy()
    broken[2, 0, 3] = np.nan
    assert "not finite" in failed_checks(broken, 0, BIRESNERF.verdict)[0]
    assert "lost" in failed_checks(poses, 4, BIRESNERF.verdict)[0]


def test_poses_far_from_the_input_doubt_its_frame_and_the_verdict_says_so():
    still = np.zeros(6)
    assert frame_doubt(still + 59, still + 0.4, 1.0, BIRESNERF.verdict) == ""
    for turned, shifted in ((still + 100, still), (still, still + 2)):
        doubt = frame_doubt(turned, shifted, 1.0, BIRESNERF.verdict)
        assert "only roughly" in doubt
        assert doubt in decide(findings(held_out(4.0), matched(1.0), out_of_frame=doubt)).why[0]


@pytest.mark.parametrize(
    ("octaves", "words"),
    [(0.0, "typically the same"), (1.0, "typically 2 times smaller"), (-1.0, "typically 2 times larger")],
)
def test_a_ratio_of_errors_is_told_in_words(octaves, words):
    assert words in decide(findings(epipolar=matched(octaves))).why[-1]


@pytest.mark.parametrize(("source", "poses"), [("given", "the input's poses"), ("seeded", "the poses found")])
def test_poses_are_the_inputs_only_where_it_held_them(source, poses):
    for sentence in decide(findings(held_out(4.0), matched(1.0), compared_with=source)).why[-2:]:
        assert f"with {poses}" in sentence

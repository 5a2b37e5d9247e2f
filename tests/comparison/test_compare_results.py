"""The conclusion on two results, against the truth that they were made from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.comparison.conclusion import ComparedFigure, Comparison
from biresnerf.geometry.similarity import Similarity
from tests.comparison.made_results import compared, in_frame, made, with_images, with_turned


def figure(said: Comparison, name: str) -> ComparedFigure:
    return next(each for each in said.figures if each.name == name)


@pytest.mark.parametrize("seed", range(5))
def test_the_result_that_is_nearer_to_the_truth_is_better_by_what_was_measured(seed: int) -> None:
    said = compared(made(0.1, 0.2, seed), made(0.8, 1.6, 100 + seed))
    assert said.outcome == "first"
    assert not said.contradict
    assert said.conclusion.startswith("The first result is better by fit of feature matches")
    assert figure(said, "Fit of feature matches").better == "first"


def test_equal_poses_are_the_same_in_any_frame() -> None:
    frame = Similarity(3.0, Rotation.from_euler("xyz", [50, 20, 10], degrees=True).as_matrix(), np.ones(3))
    said = compared(made(0.1, 0.2, 1), in_frame(made(0.1, 0.2, 1), frame))
    assert (said.outcome, said.conclusion) == ("same", "Both results hold the same poses.")
    assert said.figures == said.why == ()


def test_a_difference_within_the_bounds_that_nothing_tells_is_none() -> None:
    said = compared(made(0.05, 0.2, 1), made(0.05, 0.2, 2))
    assert said.outcome == "same"
    assert "by less than their stated accuracy, and no measure tells them apart" in said.conclusion


def test_a_difference_within_the_bounds_is_decided_by_how_many_photos_are_confirmed() -> None:
    fewer = with_images(made(0.05, 0.2, 2), {"contradicted": True}, range(4))
    said = compared(made(0.05, 0.2, 1), fewer)
    assert said.conclusion == "The first result is better by the number of photos confirmed."
    confirmed = figure(said, "Photos confirmed")
    assert (confirmed.first, confirmed.second, confirmed.better) == ("32 of 32", "28 of 32", "first")


def test_what_a_result_states_of_itself_decides_where_nothing_measured_does() -> None:
    said = compared(made(0.05, 0.4, 1), made(0.05, 0.1, 2))
    assert said.conclusion == "The second result is better by the stated accuracy."


def test_results_far_apart_contradict_each_other_and_the_evidence_favours_the_right_one() -> None:
    said = compared(made(0.05, 0.1, 1), made(17.0, 0.1, 2))
    assert (said.outcome, said.contradict) == ("first", True)
    assert said.conclusion.startswith("The results contradict each other: the poses of 32 of 32 photos")
    assert "At most one is right. The evidence favours the first" in said.conclusion
    assert "Both were called improved" in said.conclusion
    assert all(pose.contradicts for pose in said.poses)


def test_a_wrong_result_does_not_win_by_what_it_states_of_itself() -> None:
    said = compared(made(0.05, 0.5, 1), made(17.0, 0.01, 2))
    assert (said.outcome, said.contradict) == ("first", True)
    right, wrong = (made(*each, verdict=None) for each in ((0.05, 0.5, 1), (17.0, 0.01, 2)))
    said = compared(right, wrong)
    assert (said.outcome, said.contradict) == ("unknown", True)
    assert "Which one cannot be known" in said.conclusion


def test_results_far_apart_that_state_no_accuracy_contradict_each_other_too() -> None:
    said = compared(made(0.05, None, 1), made(17.0, None, 2))
    assert (said.outcome, said.contradict) == ("first", True)
    assert "and most have no stated accuracy" in said.conclusion


def test_evidence_that_disagrees_decides_nothing() -> None:
    better_views = with_images(made(0.8, 1.6, 2), {"trial_psnr_after": 30.0}, range(8))
    said = compared(made(0.1, 0.2, 1), better_views)
    assert said.outcome == "unknown"
    assert "fit of feature matches for the first and unseen views for the second" in said.conclusion


def test_matches_that_fit_neither_result_favour_none() -> None:
    far, further = (
        with_images(made(17.0, 0.1, seed), {"epipolar_px_after": px}, range(32))
        for seed, px in ((1, 20.0), (2, 40.0))
    )
    said = figure(compared(far, further), "Fit of feature matches")
    assert (said.better, said.note) == ("open", "the matches fit neither result")


def test_matches_that_poses_come_from_do_not_speak_for_them() -> None:
    report, poses = made(0.1, 0.2, 1)
    assert report.verdict is not None
    assert report.verdict.epipolar is not None
    own = report.verdict.epipolar.model_copy(update={"independent": False})
    verdict = report.verdict.model_copy(update={"epipolar": own, "heldout": None})
    seeded = report.model_copy(update={"verdict": verdict}), poses
    other = made(0.8, 1.6, 2, heldout=None)
    assert figure(compared(seeded, other), "Fit of feature matches").better == "open"
    worse_report, worse_poses = made(0.8, 1.6, 2, epipolar=own)
    independent = made(0.1, 0.2, 1)
    said = compared(independent, (worse_report, worse_poses))
    assert figure(said, "Fit of feature matches").better == "first"


def test_photos_that_contradict_each_other_are_named() -> None:
    said = compared(made(0.05, 0.2, 1), with_turned(made(0.05, 0.2, 2), 20.0, range(2)))
    names = [pose.name for pose in said.poses if pose.contradicts]
    assert names == [pose.name for pose in said.poses[:2]]
    assert not said.contradict
    assert all(name in said.conclusion for name in names)
    assert "there, at most one is right" in said.conclusion


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_a_centre_far_off_contradicts_in_any_unit(scale: float) -> None:
    """Both state 0.05 units of the first, 0.07 together: thrice that is less than 0.5, and more than 0.1."""
    report, poses = made(0.05, 0.2, 2)
    shifted = list(poses.images)
    for number, shift in ((3, 0.5), (7, 0.1)):
        pose = np.array(shifted[number].world_from_cam)
        pose[2, 3] += shift
        shifted[number] = shifted[number].model_copy(
            update={"world_from_cam": tuple(map(tuple, pose.tolist()))}
        )
    frame = Similarity(scale, np.eye(3), np.zeros(3))
    other = in_frame((report, poses.model_copy(update={"images": tuple(shifted)})), frame)
    said = compared(made(0.05, 0.2, 1), other)
    assert [pose.name for pose in said.poses if pose.contradicts] == [poses.images[3].name]
    assert (
        f"the positions of 1 of 32 photos ({poses.images[3].name}) differ by more than 3 times"
        in said.conclusion
    )


def test_a_result_that_kept_the_input_is_judged_by_the_inputs_figures() -> None:
    kept = made(17.0, None, 2, returned="input", judged="kept_input")
    said = compared(made(0.05, 0.1, 1), kept)
    assert figure(said, "Fit of feature matches").second == "20 px"
    assert figure(said, "Unseen views").second == "15.00 dB"
    assert "Both were called improved" not in said.conclusion


def test_different_photos_are_not_compared() -> None:
    report, poses = made(0.1, 0.2, 1)
    others = report.model_copy(
        update={"images": tuple(i.model_copy(update={"name": f"other/{i.name}"}) for i in report.images)}
    )
    elsewhere = poses.model_copy(
        update={"images": tuple(i.model_copy(update={"name": f"other/{i.name}"}) for i in poses.images)}
    )
    said = compared((report, poses), (others, elsewhere))
    assert (said.outcome, said.photos) == ("unknown", 0)
    assert "they have no photo in common" in said.conclusion
    assert "only 2 photos" in compared((report, poses), made(0.1, 0.2, 2, keep=2)).conclusion


def test_results_without_a_common_measure_say_so() -> None:
    said = compared(made(0.1, None, 1, verdict=None), made(0.8, None, 2))
    assert said.outcome == "unknown"
    assert any("have no photos in common whose matches were measured" in ground for ground in said.why)
    both = [made(off, 0.5, seed, verdict=None) for off, seed in ((0.5, 1), (0.8, 2))]
    for result in range(2):
        both[result] = with_images(both[result], {"uncertainty": None}, range(32))
    assert "they have no measure in common" in compared(*both).conclusion


def test_tests_of_different_length_are_no_common_measure() -> None:
    report, poses = made(0.1, 0.2, 1)
    assert report.verdict is not None
    assert report.verdict.heldout is not None
    longer = report.verdict.model_copy(
        update={"heldout": report.verdict.heldout.model_copy(update={"steps": 1000})}
    )
    said = compared((report.model_copy(update={"verdict": longer}), poses), made(0.8, 1.6, 2))
    views = figure(said, "Unseen views")
    assert (views.better, views.note) == (None, "the tests trained for 1000 and 200 steps")


def test_options_that_follow_from_the_steps_are_not_listed() -> None:
    report, poses = made(0.1, 0.2, 1)
    steps = 4 * report.options.steps
    more = report.model_copy(update={"options": report.options.with_steps(steps), "steps_done": steps})
    said = compared((report, poses), (more, poses))
    options = [each.name for each in said.figures if each.name.startswith("Option")]
    assert options == ["Option “Steps”"]
    coarser = report.model_copy(update={"options": report.options.model_copy(update={"max_image_size": 32})})
    said = compared((report, poses), (coarser, poses))
    assert [each.name for each in said.figures] == ["Option “Working image size”"]

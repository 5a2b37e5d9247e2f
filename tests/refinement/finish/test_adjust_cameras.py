"""After the last step: cameras move where left-out evidence says so, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.workload import photo_check
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.corrected_camera import corrected_camera
from biresnerf.refinement.finish import adjust_cameras as module
from biresnerf.refinement.finish import choose_poses, photo_trial
from biresnerf.refinement.finish.adjust_cameras import adjust_cameras
from biresnerf.refinement.finish.given_poses import accuracy_report
from biresnerf.refinement.finish.photo_evidence import photo_patches
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.lost.own_matches import OwnMatches
from biresnerf.refinement.parameters.intrinsics_parameters import lenses_of
from biresnerf.refinement.verdict.run_report import camera_reports, focal_warnings
from biresnerf.refinement.views.compare_rigs import Rig
from tests.refinement.adjustment.rig import disturbed, observed, rotation_errors_deg
from tests.refinement.tiny_scene import TinyRun, given_scene, tiny_optimiser, tiny_options, tiny_set

pytestmark = pytest.mark.slow

VIEWS = 9


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(2)


def begun(
    folder, rng, *, given=None, refined=0.01, noise_px=0.02, points=120, focal=1.0, centre=(0, 0), source="given"
):  # fmt: skip
    """A run whose poses ended off the truth by `refined` rad, with tracks of the full-size photos.

    The set has a focal length that is `focal` times too long, and a principal point off by `centre` focal lengths.
    """
    dataset, images = tiny_set(folder, VIEWS, 24)
    truth = dataset.world_from_cam
    tracks = observed(truth, rng.uniform(-0.5, 0.5, (points, 3)), lenses(dataset), rng, noise_px)
    if given is not None:
        frames = [
            replace(f, world_from_cam=pose) for f, pose in zip(dataset.frames, given(truth), strict=True)
        ]
        dataset = replace(dataset, frames=tuple(frames))
    wrong = tuple(
        corrected_camera(c, np.array([np.log(focal), 0.0, 0.0, *centre, *(0.0,) * 3]))
        for c in dataset.cameras
    )
    dataset = replace(dataset, cameras=wrong, intrinsics_sources=(source,) * len(wrong))
    scene = replace(given_scene(dataset, images), tracks=tracks)
    optimiser = tiny_optimiser(dataset, images, tiny_options())
    optimiser.lenses = lenses_of(dataset, images, "none", [], torch.device("cpu"))
    poses = optimiser.frame.unit_from_world.apply_to_poses(truth)
    optimiser.poses.place(torch.from_numpy(disturbed(poses, rng, refined, 2 * refined)))
    return TinyRun(optimiser, scene, folder), truth


def adjusted(run):
    made = run.optimiser
    return adjust_cameras(run.scene, made.renderer, made.recipe, run.state, run.repair)


def lenses(dataset):
    return Intrinsics.from_cameras([dataset.camera_of(i) for i in range(len(dataset))])


def errors_deg(run, truth):
    return rotation_errors_deg(run.optimiser.poses.poses().numpy(), truth)


def test_cameras_are_adjusted_where_tracks_left_out_prefer_it(tmp_path, rng):
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    before = errors_deg(run, truth)
    reports = adjusted(run).candidates
    assert [report.name for report in reports if report.chosen] == ["adjusted-tracks"]
    assert errors_deg(run, truth).mean() < 0.2 * before.mean()


FIXED = RigidBodies(np.arange(VIEWS), np.arange(VIEWS) < 3)
TRIPLES = RigidBodies(np.arange(VIEWS) // 3, np.zeros(VIEWS, np.bool_))


@pytest.mark.parametrize("bodies", [FIXED, TRIPLES], ids=["fixed", "rigs"])
def test_fixed_cameras_and_rigs_are_adjusted_within_what_is_held(tmp_path, rng, bodies):
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    optimiser, truth = run.optimiser, run.optimiser.frame.unit_from_world.apply_to_poses(truth)
    optimiser.bodies = bodies
    start = optimiser.poses.poses().numpy()
    for group in bodies.shared:
        motion = start[group[0]] @ rigid_inverse(truth[group[0]])
        start[group] = motion @ truth[group]
    start[bodies.fixed] = truth[bodies.fixed]
    optimiser.poses.place(torch.from_numpy(start))
    assert [r.name for r in adjusted(run).candidates if r.chosen] == ["adjusted-tracks"]
    found = optimiser.poses.poses().numpy()
    tie = bodies.input_from_optimised(found, truth)
    before, after = (camera_errors(tie.apply_to_poses(p), truth).rotation_deg for p in (start, found))
    assert after.mean() < 0.2 * before.mean()
    np.testing.assert_allclose(found, bodies.held(found, start), atol=1e-6)


def test_true_poses_of_the_input_are_returned(tmp_path, rng):
    run, truth = begun(tmp_path, rng)
    assert [report.name for report in adjusted(run).candidates if report.chosen] == ["input"]
    assert errors_deg(run, truth).max() < 1e-4


def test_refined_poses_stay_without_evidence(tmp_path, rng):
    run, _ = begun(tmp_path, rng)
    run.scene = replace(run.scene, tracks=None)
    before = run.optimiser.poses.poses()
    assert adjusted(run).candidates == ()
    assert torch.equal(run.optimiser.poses.poses(), before)


def test_refined_poses_stay_where_all_tracks_are_wrong(tmp_path, rng):
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    tracks = run.scene.tracks
    run.scene = replace(run.scene, tracks=replace(tracks, xy=rng.uniform(0, 24, tracks.xy.shape)))
    before = errors_deg(run, truth)
    adjusted(run)
    assert errors_deg(run, truth).mean() < 1.5 * before.mean()


def test_guessed_cameras_that_match_each_other_have_no_say(tmp_path, rng):
    """Like photos of another scene among those of a plain thing."""
    run, _ = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    foreign = np.arange(VIEWS) >= 4
    run.scene = replace(run.scene, tracks=run.scene.tracks.where(foreign[run.scene.tracks.image]))
    believed = run.optimiser.poses.poses()
    run.optimiser.camera_errors.doubt(foreign)
    assert adjusted(run).candidates == ()
    assert torch.equal(run.optimiser.poses.poses(), believed)


def test_methods_of_others_are_left_alone(tmp_path, rng):
    run, _ = begun(tmp_path, rng)
    run.optimiser.method = replace(run.optimiser.method, adjustment=False)
    assert adjusted(run).candidates == ()


def test_a_field_without_surface_gives_no_patches(tmp_path, rng):
    run, _ = begun(tmp_path, rng)
    intrinsics = lenses(run.scene.dataset)
    renderer, options, placed = run.optimiser.renderer, run.optimiser.options, np.ones(VIEWS, np.bool_)
    assert photo_patches(run.scene, renderer, options, intrinsics, Evidence(intrinsics), placed) is None


def test_a_lost_camera_is_placed_by_its_matches_and_adjusted_with_the_others(tmp_path, rng):
    run, truth = begun(
        tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3), refined=0.002, points=400
    )
    away = run.optimiser.poses.poses()[4] @ torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    run.optimiser.poses.replace(4, away[:3].float())
    run.repair = LostCameraRepair(run.optimiser, OwnMatches.of(run.scene))
    adjusted(run)
    assert run.repair.repaired == [4]
    assert errors_deg(run, truth).max() < 0.5


def focal_ratio(run):
    """Of the result over the set's."""
    before, after = run.scene.dataset.cameras[0], run.optimiser.lenses.refined(run.scene.dataset).cameras[0]
    return after.full().fx / before.full().fx


def test_a_guessed_focal_length_is_found_with_the_poses(tmp_path, rng):
    run, truth = begun(tmp_path, rng, refined=0.01, points=400, focal=1.05, source="guessed", given=wild(rng))
    before = errors_deg(run, truth)
    adjusted(run)
    assert focal_ratio(run) == pytest.approx(1 / 1.05, rel=0.005)
    assert errors_deg(run, truth).mean() < 0.2 * before.mean()
    known = run.optimiser.lenses.certainty[0]
    assert known.observable
    assert known.deviation < 0.005
    report = camera_reports(run.scene.dataset, run.optimiser.lenses)[0]
    assert (report.source, report.refined, report.observable) == ("guessed", "focal", True)


def test_an_unknown_principal_point_is_found_with_the_poses_and_nothing_else_is_freed(tmp_path, rng):
    run, truth = begun(
        tmp_path, rng, points=400, noise_px=0.004, centre=(0.02, -0.015), source="guessed", given=wild(rng)
    )
    before, true = run.scene.dataset.cameras[0], tiny_set(tmp_path / "again", VIEWS, 24)[0].cameras[0].full()
    adjusted(run)
    after = run.optimiser.lenses.refined(run.scene.dataset).cameras[0]
    assert after.model == before.model
    assert after.full().cx == pytest.approx(true.cx, abs=0.2 * abs(before.full().cx - true.cx))
    assert after.full().cy == pytest.approx(true.cy, abs=0.2 * abs(before.full().cy - true.cy))
    assert errors_deg(run, truth).mean() < 0.1


def test_a_principal_point_that_was_given_stays(tmp_path, rng):
    run, _ = begun(tmp_path, rng, points=400, centre=(0.02, -0.015), given=wild(rng))
    adjusted(run)
    assert run.optimiser.lenses.refined(run.scene.dataset).cameras == run.scene.dataset.cameras


def test_a_given_focal_length_is_kept_and_warned_of_where_matches_contradict_it(tmp_path, rng):
    run, _ = begun(tmp_path, rng, points=400, focal=1.06, given=wild(rng))
    adjusted(run)
    assert focal_ratio(run) == 1.0
    assert run.optimiser.lenses.certainty[0].contradicts == pytest.approx(1 / 1.06, rel=0.005)
    (warning,) = focal_warnings(run.scene.dataset, run.optimiser.lenses)
    assert "shorter than given" in warning


def test_a_right_focal_length_that_was_given_is_not_warned_of(tmp_path, rng):
    run, _ = begun(tmp_path, rng, points=400, given=wild(rng))
    adjusted(run)
    assert run.optimiser.lenses.certainty[0].observable
    assert run.optimiser.lenses.certainty[0].contradicts is None


def wild(rng):
    """Given poses that no evidence prefers."""
    return lambda poses: disturbed(poses, rng, 0.1, 0.3)


@pytest.mark.parametrize(("refined", "name"), [(0.0002, "refined"), (0.04, "adjusted-tracks")])
def test_tracks_that_share_their_errors_move_no_camera_within_their_accuracy(tmp_path, rng, refined, name):
    """All features of a photo lie half a noise level beside where they belong, also those left out."""
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3), refined=refined)
    tracks = observed(truth, rng.uniform(-0.5, 0.5, (400, 3)), lenses(run.scene.dataset), rng, 0.3)
    beside = rng.normal(0, 0.15, (VIEWS, 2))
    run.scene = replace(run.scene, tracks=replace(tracks, xy=tracks.xy + beside[tracks.image]))
    before = errors_deg(run, truth)
    candidates = {each.name: each for each in adjusted(run).candidates}
    assert candidates["adjusted-tracks"].track_misfit < 0.9 * candidates["refined"].track_misfit
    assert [each.name for each in candidates.values() if each.chosen] == [name]
    if name == "refined":
        assert np.array_equal(errors_deg(run, truth), before)


def test_tracks_that_judged_place_cameras_as_well_once_poses_are_chosen(tmp_path, rng):
    """The last camera sees none of the points that candidates are adjusted to."""
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    tracks, last = run.scene.tracks, VIEWS - 1
    run.scene = replace(
        run.scene, tracks=tracks.where(tracks.left_out()[tracks.point] | (tracks.image != last))
    )
    before = errors_deg(run, truth)
    assert [each.name for each in adjusted(run).candidates if each.chosen] == ["adjusted-tracks"]
    assert errors_deg(run, truth)[last] < 0.2 * before.mean()


def test_refined_poses_go_on_where_tracks_do_not_tell_them_from_the_input(tmp_path, rng):
    """The input fits them better, but the difference is within their accuracy: photos will tell."""
    run, truth = begun(
        tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.0002, 0.0004), refined=0.002, noise_px=0.3
    )
    before = errors_deg(run, truth)
    candidates = {each.name: each for each in adjusted(run).candidates}
    assert candidates["input"].track_misfit < candidates["refined"].track_misfit
    assert [each.name for each in candidates.values() if each.chosen] == ["refined"]
    assert np.array_equal(errors_deg(run, truth), before)
    assert not run.optimiser.poses_held


@pytest.mark.parametrize("name", ["adjusted", "adjusted-tracks"])
def test_fields_are_trained_only_where_patches_of_the_photos_have_not_spoken(
    tmp_path, rng, monkeypatch, name
):
    run, _ = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    adjust, asked = choose_poses.adjust, []
    monkeypatch.setattr(choose_poses, "adjust", lambda *given: {name: next(iter(adjust(*given).values()))})
    monkeypatch.setattr(module, "photos_object", lambda *_: bool(asked.append(name)))
    (chosen,) = (each.name for each in adjusted(run).candidates if each.chosen)
    assert chosen == name
    assert asked == (["adjusted-tracks"] if name == "adjusted-tracks" else [])


def test_poses_that_tracks_chose_are_adjusted_to_tracks_alone(tmp_path, rng, monkeypatch):
    """Patches that showed no surface are not adjusted to once more, which takes longer than all else."""
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    adjust, gather, seen = choose_poses.adjust, module.gather_evidence, []

    def gathered(*given):
        split = gather(*given)
        return replace(split, fitted=replace(split.fitted, patches=Untrusted()))

    class Untrusted:
        host = target = np.zeros(0, np.int64)

        def __len__(self):
            seen.append(True)
            return 0

    monkeypatch.setattr(module, "gather_evidence", gathered)
    monkeypatch.setattr(
        choose_poses, "adjust", lambda at, of, *more: adjust(at, replace(of, patches=None), *more)
    )
    before = errors_deg(run, truth)
    assert [each.name for each in adjusted(run).candidates if each.chosen] == ["adjusted-tracks"]
    assert errors_deg(run, truth).mean() < 0.2 * before.mean()
    assert not seen


def test_no_field_is_trained_where_cameras_moved_by_less_than_photos_show(tmp_path, rng, monkeypatch):
    run, _ = begun(tmp_path, rng)
    present, trained = run.optimiser.poses.poses().numpy(), []
    seen_by = tuple(run.scene.dataset.camera_of(i) for i in range(VIEWS))
    forecast = run.forecast
    monkeypatch.setattr(
        photo_trial,
        "compare_on_unseen_views",
        lambda *given: trained.append((given[-1].looks, forecast.left["checking"])),
    )
    work = photo_check(run.optimiser.options, kind=run.optimiser.schedule.kind)
    for deviation, expected in ((1e-4, []), (0.1, [((1.0,), work)])):
        other = disturbed(present, rng, deviation, deviation)
        joint, recipe = run.optimiser.joint, run.optimiser.recipe
        assert not photo_trial.photos_object(run.scene, joint, recipe, run.state, Rig(other, seen_by))
        assert trained == expected, "and it is known how long that takes"
        assert not forecast.left.get("checking")


def test_the_accuracy_of_the_input_is_measured_where_poses_were_given(tmp_path, rng):
    run, _ = begun(tmp_path, rng, given=lambda truth: disturbed(truth, rng, 0.004, 0.02))
    found = adjusted(run).given
    assert found is not None
    report = accuracy_report(found)
    assert report.rotation_deg == pytest.approx(np.degrees(0.004), rel=0.4)
    assert report.position == pytest.approx(0.02, rel=0.4)
    assert report.body_from_camera is None


def test_guessed_poses_have_no_accuracy(tmp_path, rng):
    run, _ = begun(tmp_path, rng, given=wild(rng))
    guessed = tuple(replace(frame, pose_source="neighbours") for frame in run.scene.dataset.frames)
    run.scene = replace(run.scene, dataset=replace(run.scene.dataset, frames=guessed))
    assert adjusted(run).given is None


def test_poses_of_matches_are_judged_without_the_tracks_that_judge(tmp_path, rng):
    """Photos alone: the mapper fitted its poses to all of few tracks."""
    run, truth = begun(tmp_path, rng, points=100, source="colmap", given=wild(rng))
    dataset = run.scene.dataset
    evidence = Evidence(lenses(dataset), run.scene.tracks)
    mapped = adjust_poses(truth, evidence, PosePrior.equal(truth, 0.1, 0.4)).world_from_cam
    frames = tuple(replace(f, world_from_cam=pose) for f, pose in zip(dataset.frames, mapped, strict=True))
    source = "matches-incremental"
    start = InitialPoses(mapped, source, (source,) * VIEWS, (), mapped)
    run.scene = replace(run.scene, dataset=replace(dataset, frames=frames), start=start)
    misfits = {each.name: each.track_misfit for each in adjusted(run).candidates}
    assert misfits["input"] == misfits["matched"] == pytest.approx(misfits["adjusted-tracks"], rel=0.03)

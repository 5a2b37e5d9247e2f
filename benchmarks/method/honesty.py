"""Tests whether reports are honest: ``python -m benchmarks.method.honesty SET...``.

Each SET holds true poses. It is refined from eleven kinds of input (`STARTS`). Two things must never happen: the
verdict ``improved`` although the placed cameras' true error rose, and a camera more than 5 degrees off that the report
does not name. Prints a JSON line for each run, and the counts at the end.

Photos are at most 400 px for feature matching and 100 px for the field, every few views of large sets, so that a run
takes about a minute of one core. With ``--set start=given`` there are no matches, so photos alone judge.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.method.seeding import shrunk, with_focal
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import POSES, matrix_of, read_poses_json
from biresnerf.data.model.dataset import GUESSES, Dataset
from biresnerf.data.model.refined_set import REFINED
from biresnerf.data.photos.alike.copied_photos import without_copies
from biresnerf.data.photos.guessed_lens import GUESSED_FOCAL
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.errors import FaultError, InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import orbit_away, perturb_poses
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_robust
from biresnerf.options.refine_options import parse_options
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.stages.checkpoint import SEEDING, TRACKS
from biresnerf.report import ImageReport, Report
from biresnerf.studies.scenes import with_poses

Array = NDArray[np.float64]

STARTS = (
    "true", "matches", "noise 0.005", "noise 0.05", "noise 0.15", "noise 0.35", "tenth lost", "foreign photos",
    "wrong lens", "wrong matches", "photos alone",
)  # fmt: skip
VIEWS = 30
MATCHED_PX, FIELD_PX = 400, 100
FOREIGN = 3
BEYOND_DEG = 5.0
RISEN = 1.05  # the error after, over the error before
RISEN_DEG = 0.02  # and by at least so much: what the truth of the sets is good for


def named(image: ImageReport) -> bool:
    """Whether the report tells the user not to rely on this pose."""
    known = image.uncertainty
    return known is not None and (known.rotation_deg is None or known.rotation_deg > BEYOND_DEG)


def given_set(truth: Dataset, start: str, seed: int, others: Dataset) -> Dataset:
    """The input to refine: the truth with an error."""
    poses = truth.world_from_cam
    if start == "true":
        return truth
    if start == "photos alone":
        return without_lenses(without_poses(truth))
    if start == "matches":
        found = seed_poses(without_poses(truth), seed=seed)
        matched = [c for c in found.candidates if c.matched.any()]
        if not matched:
            raise InputError("no_matches", "feature matches place nothing.")
        return with_poses(truth, matched[0].world_from_cam)
    if start.startswith("noise"):
        return with_poses(truth, perturb_poses(poses, float(start.split()[1]), seed=seed))
    noisy = perturb_poses(poses, 0.05, seed=seed)
    if start == "tenth lost":
        lost = np.random.default_rng(seed).choice(len(truth), max(1, len(truth) // 10), replace=False)
        return with_poses(truth, orbit_away(noisy, [int(i) for i in lost], seed))
    if start == "wrong lens":
        return replace(
            with_poses(truth, noisy), cameras=tuple(with_focal(camera, 1.05) for camera in truth.cameras)
        )
    if start == "foreign photos":
        return with_foreign_photos(with_poses(truth, noisy), others)
    return with_poses(truth, noisy)


def without_poses(truth: Dataset) -> Dataset:
    frames = (replace(frame, world_from_cam=None, pose_source=None) for frame in truth.frames)
    return replace(truth, frames=tuple(frames))


def without_lenses(truth: Dataset) -> Dataset:
    """The set with a guess for each lens, as of photos without EXIF."""
    guesses = []
    for camera in truth.cameras:
        width, height = camera.width, camera.height
        focal = GUESSED_FOCAL * max(width, height)
        guesses.append(Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0)))
    return replace(truth, cameras=tuple(guesses), intrinsics_sources=("guessed",) * len(guesses))


def with_foreign_photos(dataset: Dataset, others: Dataset) -> Dataset:
    """The set with a few photos of another scene, whose poses are missing."""
    first = len(dataset.cameras)
    foreign = [
        replace(
            f, name=f"foreign/{f.path.name}", camera=first + f.camera, world_from_cam=None, pose_source=None
        )
        for f in others.frames[:: max(1, len(others) // FOREIGN)][:FOREIGN]
    ]
    sources = tuple(dataset.source_of_intrinsics(i) for i in range(first))
    sources += tuple(others.source_of_intrinsics(i) for i in range(len(others.cameras)))
    return replace(
        dataset,
        frames=(*dataset.frames, *foreign),
        cameras=(*dataset.cameras, *others.cameras),
        intrinsics_sources=sources,
    )


def match_wrongly(given: Dataset, output: Path, share: float, seed: int) -> None:
    """Store COLMAP's answer where a run of the set finds it, with this share of wrong observations.

    They have the positions of other observations.
    """
    matched = without_copies(given, ())
    seed_poses(matched, seed=seed, remember=output / SEEDING)
    tracks = Tracks.load(output / TRACKS, matched.names)
    if tracks is None:
        return
    rng = np.random.default_rng(seed)
    wrong = np.flatnonzero(rng.random(len(tracks)) < share)
    xy = tracks.xy.copy()
    xy[wrong] = tracks.xy[rng.permutation(wrong)]
    np.savez(output / TRACKS, names=np.array(matched.names), **replace(tracks, xy=xy).kept())


def errors_deg(poses: Array, truth: Array, placed: NDArray[np.bool_]) -> Array:
    """Rotation errors [n] after an alignment of the placed cameras that is robust to lost ones."""
    carried = align_robust(poses[placed], truth[placed], with_rotations=True).apply_to_poses(poses)
    return camera_errors(carried, truth).rotation_deg


def judged(truth: Dataset, report: Report, before: Array, result: Array, refined: Array) -> dict[str, object]:
    """The truth and the report about one run that returned poses, refined or given ones."""
    poses, count = truth.world_from_cam, len(truth)
    placed = np.array([image.pose_source not in GUESSES for image in report.images[:count]])
    before, after, found = (errors_deg(each[:count], poses, placed) for each in (before, result, refined))
    old, new = float(before[placed].mean()), float(after[placed].mean())
    said = report.verdict
    assert said is not None
    verdict = said.verdict
    silent = [
        i.name for i, error in zip(report.images, after, strict=False) if error > BEYOND_DEG and not named(i)
    ]
    unnamed = [i.name for i in report.images[count:] if not named(i)]  # of another scene: no pose is right
    return {
        "verdict": verdict,
        "views": said.heldout.psnr.finding if said.heldout else None,
        "matches": said.epipolar.error_px.finding if said.epipolar else None,
        "gain_db": round(said.heldout.psnr.difference, 2) if said.heldout else None,
        "moved_px": round(said.moved_px, 2),
        "missed_px": round(said.heldout.missed_px, 2) if said.heldout and said.heldout.missed_px else None,
        "chosen": next((c.name for c in report.candidates if c.chosen), None),
        "before_deg": round(old, 3),
        "refined_deg": round(float(found[placed].mean()), 3),
        "after_deg": round(new, 3),
        "worst_deg": round(float(after.max()), 2),
        "wrongly_improved": verdict == "improved" and new > max(RISEN * old, old + RISEN_DEG),
        "worsened": new > max(RISEN * old, old + RISEN_DEG),
        "silent": silent,
        "foreign_unnamed": len(unnamed),
        "named": sum(named(image) for image in report.images),
    }


def run(
    truth: Dataset, start: str, seed: int, others: Dataset, options: dict[str, object]
) -> dict[str, object]:
    given = given_set(truth, start, seed, others)
    asked = parse_options(
        {"preset": "fast", "seed": seed, "max_image_size": FIELD_PX, "orbit_frames": 0, **options}
    )
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        if start == "wrong matches":
            match_wrongly(given, output, 0.3, seed)
        report = refine_poses(given, output, asked)
        before, result = poses_in(output, report)
        refined = poses_in(output / REFINED, report)[1] if (output / REFINED).exists() else result
    return judged(truth, report, before, result, refined)


def poses_in(folder: Path, report: Report) -> tuple[Array, Array]:
    """Poses before and after, each [n, 4, 4], in the report's order; those after stand in for missing ones before."""
    found = {image.name: image for image in read_poses_json(folder / POSES).images}
    images = [found[image.name] for image in report.images]
    after = [matrix_of(image.world_from_cam) for image in images]
    before = [
        pose if image.world_from_cam_before is None else matrix_of(image.world_from_cam_before)
        for image, pose in zip(images, after, strict=True)
    ]
    return np.stack(before), np.stack(after)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", type=Path, nargs="+")
    parser.add_argument(
        "--foreign", type=Path, help="Where foreign photos come from; the next of SETS if left out."
    )
    parser.add_argument("--starts", default=",".join(STARTS))
    parser.add_argument("--views", type=int, default=VIEWS, help="Of a set, at most.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    asked = parser.parse_args()
    from biresnerf.commands.settings_option import parse_settings

    options = parse_settings(tuple(asked.set))
    lines: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as scratch:
        sets = {
            path: small(path, Path(scratch), asked.views)
            for path in dict.fromkeys((*asked.sets, asked.foreign))
            if path
        }
        for i, path in enumerate(asked.sets):
            others = sets[asked.foreign or asked.sets[(i + 1) % len(asked.sets)]]
            for start in asked.starts.split(","):
                began, line = time.monotonic(), {"set": path.name, "start": start}
                try:
                    line |= run(sets[path], start, asked.seed, others, options)
                except FaultError as error:
                    line |= {"refused": error.fault.code}
                lines.append(line | {"seconds": round(time.monotonic() - began)})
                print(json.dumps(lines[-1]), flush=True)
    ran = [line for line in lines if "refused" not in line]
    print(
        f"{len(ran)} runs: {sum(bool(line['wrongly_improved']) for line in ran)} said improved though the error rose, "
        f"{sum(bool(line['worsened']) for line in ran)} returned poses with a larger error, "
        f"{sum(bool(line['silent']) for line in ran)} left a camera beyond {BEYOND_DEG:g} degrees unnamed"
    )


def small(path: Path, scratch: Path, views: int = VIEWS) -> Dataset:
    """A few small views of a set, under new names."""
    truth = read_dataset(path)
    posed = tuple(frame for frame in truth.frames if frame.world_from_cam is not None)
    every = -(-len(posed) // views)
    folder = scratch / path.name
    folder.mkdir()
    made = shrunk(replace(truth, frames=posed[::every]), MATCHED_PX, folder)
    frames = tuple(replace(frame, name=f"{path.name}-{frame.path.stem}.png") for frame in made.frames)
    return replace(made, frames=frames)


if __name__ == "__main__":
    main()

"""Results of all parts of a made flight, without refining any: to join more photos than one machine refines in a day.

    python -m benchmarks.large.made_aerial SCENE --photos 10000 --width 96 --poses
    python -m benchmarks.large.made_parts SCENE PARTS
    biresnerf refine SCENE --join PARTS --output JOINED --preset fast --seed 1
    biresnerf evaluate JOINED SCENE.truth.json

Points on the ground are projected into the true cameras, with noise, and each part's cameras are adjusted to them from
the given poses, by what adjusts them in a run. So parts bend and have bounds as real ones do. What the photos show
plays no role, so they may be tiny: the noise is of photos of 640 px.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.sets.aerial_ground import surface_height
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.result_formats import write_result_formats
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.part_of_set import without_photos
from biresnerf.data.model.refined_set import RefinedSet, refined_set
from biresnerf.data.parts.cut_set import PHOTOS
from biresnerf.data.photos.images import load_images
from biresnerf.data.points.refined_points import with_matched_points
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.refine_options import parse_options
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.finish.expected_errors import expected_errors
from biresnerf.run.split_set import photos_of_parts
from biresnerf.uncertainty import PoseUncertainty
from biresnerf.write.output_folder import REPORT

Array = NDArray[np.float64]

SEEN = 150  # points in a photo
NOISE = 0.5 / 640  # of an observation, in widths of a photo
GIVEN_DEG, GIVEN_M = 3.0, 3.0  # the prior on the given poses


def seen_points(dataset: Dataset, truth: Array, seed: int) -> Tracks:
    """Points on the ground as the true cameras see them; houses hide none."""
    rng, lens = np.random.default_rng(seed), dataset.camera_of(0)
    centres, footprint = truth[:, :2, 3], truth[:, 2, 3].mean() * lens.width / lens.params[0]
    low, high = centres.min(0) - footprint, centres.max(0) + footprint
    count = int(SEEN * np.prod(high - low) / (footprint**2 * lens.height / lens.width))
    ground = rng.uniform(low, high, (count, 2))
    points = np.column_stack([ground, [surface_height(x, y, seed) for x, y in ground]])
    focal, middle = np.array(lens.params[:2]), np.array(lens.params[2:4])
    found: list[tuple[NDArray[np.int64], Array]] = []
    for cam_from_world in rigid_inverse(truth):
        in_cam = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        xy = focal * in_cam[:, :2] / in_cam[:, 2:] + middle + rng.normal(0, NOISE * lens.width, (count, 2))
        visible = (in_cam[:, 2] > 0) & ((xy > 0) & (xy < [lens.width, lens.height])).all(1)
        found.append((np.flatnonzero(visible), xy[visible]))
    point = np.concatenate([numbers for numbers, _ in found])
    image = np.repeat(np.arange(len(truth)), [len(numbers) for numbers, _ in found])
    order = np.lexsort((image, point))
    tracks = Tracks.of(point[order], image[order], np.concatenate([xy for _, xy in found])[order])
    assert tracks is not None
    return tracks


def made_part(dataset: Dataset, tracks: Tracks) -> RefinedSet:
    """The result of a part: its cameras adjusted to what they see, and their bounds."""
    given = np.stack([frame.world_from_cam for frame in dataset.frames if frame.world_from_cam is not None])
    intrinsics = Intrinsics.from_cameras([dataset.camera_of(i) for i in range(len(dataset))])
    evidence = Evidence(intrinsics, tracks)
    prior = PosePrior.equal(given, float(np.radians(GIVEN_DEG)), GIVEN_M)
    poses = adjust_poses(given, evidence, prior).world_from_cam
    turned, shifted = expected_errors(poses, poses, evidence).bounds_90()
    known = [
        PoseUncertainty(known_from="matches", rotation_deg=float(np.degrees(a)), position=float(b))
        for a, b in zip(turned, shifted, strict=True)
    ]
    refined = refined_set(dataset, poses, uncertainty=known)
    return with_matched_points(refined, tracks, load_images(dataset, 64))


def of_rows(tracks: Tracks, rows: NDArray[np.int64]) -> Tracks:
    """The tracks through these images alone, which are numbered anew."""
    number = {row: new for new, row in enumerate(rows.tolist())}
    kept = tracks.where(np.isin(tracks.image, rows))
    assert kept is not None
    return replace(kept, image=np.array([number[row] for row in kept.image.tolist()], np.int64))


def main() -> None:
    """Write the results of all parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("parts", type=Path)
    parser.add_argument("--most", type=int, default=PHOTOS, help="Photos of a part.")
    parser.add_argument("--seed", type=int, default=1, help="Of the made flight.")
    asked = parser.parse_args()
    dataset = read_dataset(asked.scene)
    truth = read_dataset(asked.scene.with_name(f"{asked.scene.name}.truth.json")).world_from_cam
    assert truth is not None
    tracks = seen_points(dataset, truth, asked.seed)
    print(f"{len(dataset)} photos, {tracks.points} points, {len(tracks.point)} observations")
    row_of = {name: row for row, name in enumerate(dataset.names)}
    parts = photos_of_parts(dataset, parse_options({}), asked.most)
    for number, names in enumerate(parts, start=1):
        rows = np.array([row_of[name] for name in names])
        part = made_part(without_photos(dataset, (), names), of_rows(tracks, rows))
        folder = asked.parts / f"part-{number:02}"
        folder.mkdir(parents=True, exist_ok=True)
        write_result_formats(part, folder)
        (folder / REPORT).write_text("{}")  # who joins parts asks for one, and reads nothing of it
        print(f"part {number} of {len(parts)}: {len(names)} photos", flush=True)


if __name__ == "__main__":
    main()

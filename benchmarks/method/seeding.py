"""Seeding on a set of known poses: `python -m benchmarks.method.seeding SET [--missing 0.2] [--size 200]`.

Without options, all poses and lenses are removed, as if SET were a folder of images. `--missing` removes that share of
the poses (`numpy.random.default_rng(0)`) and gives the others BARF's noise (seed 1); lenses stay. Errors are rotations
after alignment of all cameras by their centres. `--focal 1.05` makes given focal lengths 5 % too long, `--effort low`
uses the effort of a job that ran out of memory before.
"""

from __future__ import annotations

import argparse
import logging
import resource
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.guessed_lens import guess_lens
from biresnerf.data.photos.image_files import read_header
from biresnerf.data.photos.images import load_images
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread


def without_cameras(truth: Dataset) -> Dataset:
    """The photos without any information about them."""
    cameras, frames = {}, []
    for frame in truth.frames:
        camera, source = guess_lens(read_header(frame.path, frame.name))
        cameras.setdefault(camera, (len(cameras), source))
        frames.append(
            replace(frame, camera=cameras[camera][0], world_from_cam=None, pose_source=None, orientation=1)
        )
    sources = tuple(source for _, source in cameras.values())
    return replace(truth, cameras=tuple(cameras), frames=tuple(frames), intrinsics_sources=sources)


def with_missing_poses(truth: Dataset, missing: float, noise: float) -> Dataset:
    """The set with a share of the poses missing, the others noisy."""
    count = len(truth)
    gone = set(np.random.default_rng(0).choice(count, round(missing * count), replace=False).tolist())
    noisy = perturb_poses(truth.world_from_cam, noise, seed=1)
    frames = (
        replace(frame, world_from_cam=None, pose_source=None)
        if i in gone
        else replace(frame, world_from_cam=pose)
        for i, (frame, pose) in enumerate(zip(truth.frames, noisy, strict=True))
    )
    return replace(truth, frames=tuple(frames))


def shrunk(truth: Dataset, size: int, folder: Path) -> Dataset:
    """Copies of the photos in `folder`, `size` px at most, with scaled lenses."""
    images = load_images(truth, size)
    frames = []
    for i, frame in enumerate(truth.frames):
        path = folder / f"{i:04}.png"
        Image.fromarray(images.image(i)).save(path)
        frames.append(replace(frame, path=path, camera=i, orientation=1, mask=None))
    cameras = dict.fromkeys(images.cameras)
    index = {camera: i for i, camera in enumerate(cameras)}
    frames = [replace(f, camera=index[c]) for f, c in zip(frames, images.cameras, strict=True)]
    return replace(truth, root=folder, cameras=tuple(cameras), frames=tuple(frames), intrinsics_sources=())


def with_focal(camera: Camera, times: float) -> Camera:
    """The camera with its focal lengths multiplied by a factor."""
    count = 2 if camera.model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV") else 1
    return replace(
        camera, params=(*(times * focal for focal in camera.params[:count]), *camera.params[count:])
    )


def errors_of(candidate: InitialPoses, truth: Dataset, which: np.ndarray) -> str:
    if not which.any():
        return "none"
    poses = candidate.world_from_cam
    errors = camera_errors(
        align_by_spread(poses, truth.world_from_cam).apply_to_poses(poses), truth.world_from_cam
    )
    turned = errors.rotation_deg[which]
    return f"{turned.mean():.2f} deg, at most {turned.max():.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("set", type=Path)
    parser.add_argument("--missing", type=float)
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--size", type=int)
    parser.add_argument("--focal", type=float, default=1.0)
    parser.add_argument("--effort", choices=("full", "low"), default="full")
    asked = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    truth = read_dataset(asked.set)
    truth = replace(truth, frames=tuple(f for f in truth.frames if f.world_from_cam is not None))
    with tempfile.TemporaryDirectory(prefix="biresnerf-benchmark-") as folder:
        if asked.size:
            truth = shrunk(truth, asked.size, Path(folder))
        given = (
            without_cameras(truth)
            if asked.missing is None
            else with_missing_poses(truth, asked.missing, asked.noise)
        )
        given = replace(given, cameras=tuple(with_focal(camera, asked.focal) for camera in given.cameras))
        began = time.monotonic()
        found = seed_poses(given, effort=asked.effort)
        seconds = time.monotonic() - began
    missing, all_of_them = ~given.posed, np.ones(len(truth), dtype=bool)
    for candidate in found.candidates:
        sources = Counter(source for source, gone in zip(candidate.sources, missing, strict=True) if gone)
        print(
            f"{asked.set.name}, {candidate.source}: {errors_of(candidate, truth, all_of_them)}; "
            f"missing ones {errors_of(candidate, truth, missing)}, from {dict(sources)}"
        )
    for warning in found.dataset.warnings:
        print(warning)
    known, was = found.dataset.cameras[0].full(), truth.cameras[0].full()
    print(f"focal length {known.fx:.1f} px, in truth {was.fx:.1f}; {seconds:.0f} s")
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"COLMAP's process: {most:.0f} MiB at the highest")


if __name__ == "__main__":
    main()

"""Runs COLMAP on a folder of images, in a process of its own: ``python -P colmap_child.py REQUEST.json``.

REQUEST.json names the images, the work folder and where the answer goes. pycolmap is kept out of every other
process: its crashes end this one only, and time limits and cancelling work by ending this process.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
import sys
import time

# pycolmap's wheels export another zlib; Python's own must be bound first, or PNG and gzip corrupt the heap.
import zlib  # noqa: F401
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.seeding.colmap_pairs import (
    drop_contradicting_pairs,
    leave_out_still,
    match_features,
    matched_pairs,
    write_position_priors,
)
from biresnerf.data.seeding.colmap_tracks import keep_from_mapping, write_tracks
from biresnerf.data.seeding.seeding_progress import MATCHED

DATABASE = "database.db"
SAYS = "seeding: "  # before lines meant for the job's log; all others are COLMAP's own
# Small photos have few features: faint ones count as well, and fewer matches than COLMAP asks for must do.
FAINTEST_PEAK, LEAST_SEEN = 0.003, 10
ENOUGH_PLACED = 0.8  # of the images: where all poses are given, no other way of mapping is tried then
# Growth of a model after which all of it is adjusted, where poses are given: temple takes 7.8 s in place of 16.2 with
# 1.1, fox 13.6 in place of 20.5, and both are as exact (0.191 and 0.053 deg).
RARELY = 1.4
INTRINSICS_FROM = 0.5  # of the images: a model of fewer does not say what the lens is
PHOTOS_AT_ONCE = 100  # between two copies of the database


def main(request_path: Path) -> None:
    """Does what the request asks and writes its ``answer``."""
    request: dict[str, Any] = json.loads(request_path.read_text("utf-8"))
    Path(request["answer"]).write_text(json.dumps(map_images(request)), "utf-8")


def say(text: str) -> None:
    """Print a line for the job's log."""
    sys.stdout.write(f"{SAYS}{text}\n")
    sys.stdout.flush()


def map_images(request: dict[str, Any]) -> dict[str, Any]:
    """Features and matches; the largest model of image by image mapping, guided by the poses there are.

    Also global mapping's, which places more and makes more mistakes: always where poses are missing, else where the
    first leaves out many images.
    """
    import pycolmap

    work = Path(request["work"])
    database, images = work / DATABASE, Path(request["root"])
    count = sum(len(camera["names"]) for camera in request["cameras"])
    pycolmap.set_random_seed(request["seed"])
    kept = Path(request["kept"]) if request["kept"] else None
    copies = DatabaseCopies(database, kept, request["copy_every_s"])
    if copies.restore():
        say("features and matches that were found before are taken up again")
    else:
        import_images(request, database, images)
    extract_features(request, database, images, extraction_options(request), copies.now_and_then)
    numbers = camera_numbers(request, database)
    tie_rigs(database, request["rigs"])
    say(f"features of {count} images found")
    match_features(request, database, work, copies.now_and_then)
    if still := leave_out_still(request, database):
        say("two motions in many pairs: matches that stay where they are are left out")
    (work / MATCHED).touch()
    tracks = write_tracks(database, work)
    if request["cam_from_world"]:
        drop_contradicting_pairs(database, request["cam_from_world"])
        write_position_priors(database, request["cam_from_world"], request["position_deviation"])
    matches = matched_pairs(database)
    say(f"{len(matches)} pairs of images match")
    if tracks is not None:
        keep_from_mapping(database, tracks)

    answer: list[dict[str, Any]] = []
    mappers = (("incremental", map_incrementally), ("global", map_globally))
    for mapper, run in mappers if request["maps"] else ():
        (work / mapper).mkdir()
        models = run(database, images, work / mapper, request, numbers)
        if not models:
            say(f"{mapper} mapping: no model")
            continue
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
        answer.append({"mapper": mapper, **describe(best, numbers)})
        placed = best.num_reg_images()
        say(
            f"{mapper} mapping: {placed} of {count} images, {best.num_points3D()} points, "
            f"error {answer[-1]['reprojection_px']:.2f} px, {len(models)} models"
        )
        if len(request["cam_from_world"]) == count and placed >= ENOUGH_PLACED * count:
            break
        if mapper == "incremental" and placed >= INTRINSICS_FROM * count:
            keep_intrinsics(database, best, request, numbers)
    return {"models": answer, "matches": matches, "still": still}


class DatabaseCopies:
    """Copies of the database, made now and then while it grows: a run that is killed goes on from the last one.

    The database itself lies in a temporary folder, as databases do badly on network drives; a copy is one whole file.
    Copies are made between calls of pycolmap, when it holds no lock: it brings an SQLite of its own. Nothing is copied
    where ``kept`` is None.
    """

    def __init__(self, database: Path, kept: Path | None, every_s: float) -> None:
        self._database, self._kept, self._every_s = database, kept, every_s
        self._next = time.monotonic() + every_s

    def restore(self) -> bool:
        """Begin with the copy of an earlier run, if there is one."""
        if self._kept is None or not self._kept.is_file():
            return False
        shutil.copyfile(self._kept, self._database)
        return True

    def now_and_then(self) -> None:
        """Copy what has been added, if it is time."""
        begun = time.monotonic()
        if self._kept is None or begun < self._next:
            return
        with (
            whole_file(self._kept) as temporary,
            closing(sqlite3.connect(self._database)) as growing,
            closing(sqlite3.connect(temporary)) as copy,
        ):
            growing.backup(copy)
        done = time.monotonic()
        self._next = done + self._every_s * max(1.0, done - begun)  # large ones are made rarely


def extraction_options(request: dict[str, Any]) -> Any:
    """How thoroughly to look for features: pycolmap's options."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = request["widest_image"]
    extraction.num_threads = request["threads"]
    extraction.sift.max_num_features = request["most_features"]
    extraction.sift.peak_threshold = FAINTEST_PEAK
    extraction.sift.domain_size_pooling = extraction.sift.estimate_affine_shape = request["thorough"]
    return extraction


def import_images(request: dict[str, Any], database: Path, images: Path) -> None:
    """Number the cameras and their photos in their order; else those come first that a thread is done with first."""
    import pycolmap

    pycolmap.Database.open(database).close()
    for camera in request["cameras"]:
        if camera["names"]:
            pycolmap.import_images(
                database,
                images,
                camera_mode=pycolmap.CameraMode.SINGLE,
                image_names=camera["names"],
                options=_reader(request, camera),
            )


def extract_features(
    request: dict[str, Any],
    database: Path,
    images: Path,
    extraction: Any,
    after_some: Callable[[], None] = lambda: None,
) -> None:
    """Features of all photos that have none yet; ``after_some`` is called now and then."""
    import pycolmap

    for camera in request["cameras"]:
        for first in range(0, len(camera["names"]), PHOTOS_AT_ONCE):
            pycolmap.extract_features(
                database,
                images,
                image_names=camera["names"][first : first + PHOTOS_AT_ONCE],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=_reader(request, camera),
                extraction_options=extraction,
            )
            after_some()


def _reader(request: dict[str, Any], camera: dict[str, Any]) -> Any:
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera["model"]
    if request["masks"] is not None:
        reader.mask_path = request["masks"]
    if camera["params"] is not None:
        reader.camera_params = ",".join(repr(float(value)) for value in camera["params"])
    return reader


def camera_numbers(request: dict[str, Any], database: Path) -> list[int]:
    """The database's number of each camera in the request; -1 of one without photos."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        camera_of = {image.name: image.camera_id for image in opened.read_all_images()}
    firsts = [camera["names"][0] if camera["names"] else "" for camera in request["cameras"]]
    return [camera_of.get(name, -1) for name in firsts]


def tie_rigs(database_path: Path, rigs: list[list[list[tuple[str, list[list[float]]]]]]) -> None:
    """Ties photos taken at once, from one centre, into frames of rigs.

    A rig is a list of moments, each a list of photos with their rotations [3, 3] from the rig.
    """
    import numpy as np
    import pycolmap

    if not rigs:
        return
    with pycolmap.Database.open(database_path) as database:
        images = {image.name: image for image in database.read_all_images()}
        tied = {name for rig in rigs for moment in rig for name, _ in moment}
        single = [[[(name, np.eye(3).tolist())]] for name in images if name not in tied]
        database.clear_frames()
        database.clear_rigs()
        written: dict[int, int] = {}  # by the first camera
        for moments in [*rigs, *single]:
            turns = {
                images[name].data_id.sensor_id: np.array(turn) for moment in moments for name, turn in moment
            }
            (first, reference), *others = turns.items()
            if first.id not in written:
                rig = pycolmap.Rig()
                rig.add_ref_sensor(first)
                for sensor, turn in others:
                    rotation = pycolmap.Rotation3d(turn @ reference.T)
                    rig.add_sensor(sensor, pycolmap.Rigid3d(rotation, np.zeros(3)))
                written[first.id] = database.write_rig(rig)
            for moment in moments:
                frame = pycolmap.Frame()
                frame.rig_id = written[first.id]
                for name, _ in moment:
                    frame.add_data_id(images[name].data_id)
                database.write_frame(frame)


def map_incrementally(
    database: Path, images: Path, work: Path, request: dict[str, Any], numbers: list[int]
) -> dict[int, Any]:
    """Models by adding image to image, with position priors; few matches suffice, as images may be small."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False  # the photos would be read again
    known = [number for number, c in zip(numbers, request["cameras"], strict=True) if c["known"]]
    options.random_seed, options.num_threads = request["seed"], request["mapping_threads"]
    options.min_model_size, options.min_num_matches = 3, 10
    options.ba_refine_focal_length = options.ba_refine_extra_params = len(known) < len(numbers)
    options.constant_cameras = set(known)
    options.ba_refine_sensor_from_rig = False
    guided = len(request["cam_from_world"]) >= 3
    options.use_prior_position = options.use_robust_loss_on_prior_position = guided
    if request["likeliest"] is not None:  # all cameras are adjusted again at the end of a run
        options.ba_global_frames_ratio = options.ba_global_points_ratio = RARELY
        options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
    mapper, scale = options.mapper, request["error_scale"]
    mapper.init_min_num_inliers, mapper.abs_pose_min_num_inliers = 3 * LEAST_SEEN, LEAST_SEEN
    mapper.init_min_tri_angle, mapper.max_reg_trials = 8.0, 6
    mapper.init_max_error *= scale
    mapper.abs_pose_max_error *= scale
    mapper.filter_max_reproj_error *= scale
    return pycolmap.incremental_mapping(database, images, work, options)


def map_globally(
    database: Path, images: Path, work: Path, request: dict[str, Any], numbers: list[int]
) -> dict[int, Any]:
    """Models by averaging all pairs' rotations, then placing all cameras at once."""
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = request["seed"], request["mapping_threads"]
    options.mapper.random_seed, options.mapper.num_threads = request["seed"], request["mapping_threads"]
    fixed = all(camera["known"] for camera in request["cameras"])
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = not fixed
    adjustment.refine_principal_point = adjustment.refine_sensor_from_rig = False
    return pycolmap.global_mapping(database, images, work, options)


def keep_intrinsics(database_path: Path, model: Any, request: dict[str, Any], numbers: list[int]) -> None:
    """Keep the lenses found by image by image mapping for what follows, so that models can be compared."""
    import pycolmap

    database = pycolmap.Database.open(database_path)
    for camera, number in zip(request["cameras"], numbers, strict=True):
        if not camera["known"] and number in model.cameras:
            found = model.cameras[number]
            found.has_prior_focal_length = True
            database.update_camera(found)
            camera["known"] = True
    database.close()


def describe(model: Any, numbers: list[int]) -> dict[str, Any]:
    """Cameras, by their place in the request, and poses of one model, and how well it explains its matches."""
    seen = {image.camera_id for image in model.images.values() if image.has_pose}
    cameras = {
        str(index): {
            "model": model.cameras[number].model.name,
            "width": model.cameras[number].width,
            "height": model.cameras[number].height,
            "params": [float(value) for value in model.cameras[number].params],
        }
        for index, number in enumerate(numbers)
        if number in seen
    }
    images = [
        {"name": image.name, "cam_from_world": image.cam_from_world().matrix().tolist()}
        for image in model.images.values()
        if image.has_pose
    ]
    return {
        "cameras": cameras,
        "images": images,
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "reprojection_px": float(model.compute_mean_reprojection_error()),
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))

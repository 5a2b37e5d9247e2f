"""Runs COLMAP on a folder of images, in a process of its own: ``python -P colmap_child.py REQUEST.json``.

REQUEST.json names the images, the work folder and where the answer goes. pycolmap is kept out of every other
process: its crashes end this one only, and time limits and cancelling work by ending this process.
"""

from __future__ import annotations

import json
import sys

# pycolmap's wheels export another zlib; Python's own must be bound first, or PNG and gzip corrupt the heap.
import zlib  # noqa: F401
from pathlib import Path
from typing import Any

MAX_IMAGE_SIZE = 1600  # long side (px) at which features are found; more costs time and adds little
SEQUENTIAL_OVERLAP = 12  # neighbours that each image is matched with, where all pairs would be too many
# Small photos have few features: faint ones count as well, and fewer matches than COLMAP asks for must do.
FAINTEST_PEAK, LEAST_MATCHES, LEAST_SEEN = 0.003, 12, 10
ENOUGH_PLACED = 0.8  # of the images: no other way of mapping is tried then
PAIR_OUTLIER = 3.0  # median disagreements beyond which a pair's matches are taken for repeated structure
PAIR_OUTLIER_DEG = 30.0  # but not below this


def main(request_path: Path) -> None:
    """Does the request's task and writes its ``answer``."""
    request: dict[str, Any] = json.loads(request_path.read_text("utf-8"))
    task = {"from_scratch": map_from_scratch, "from_given": map_from_given}[request["task"]]
    Path(request["answer"]).write_text(json.dumps(task(request)), "utf-8")


def map_from_scratch(request: dict[str, Any]) -> dict[str, Any]:
    """Features, matches, incremental mapping; the largest model found."""
    import pycolmap

    work = Path(request["work"])
    database, images = work / "database.db", Path(request["root"])
    pycolmap.set_random_seed(request["seed"])

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = MAX_IMAGE_SIZE
    mode = pycolmap.CameraMode.PER_IMAGE if request["camera_per_image"] else pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, images, image_names=request["names"], camera_mode=mode, reader_options=reader,
        extraction_options=extraction,
    )  # fmt: skip
    if request["sequential"]:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = SEQUENTIAL_OVERLAP
        pycolmap.match_sequential(database, pairing_options=pairing)
    else:
        pycolmap.match_exhaustive(database)

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.random_seed = request["seed"]
    (work / "sparse").mkdir()
    models = pycolmap.incremental_mapping(database, images, work / "sparse", options)
    return describe_largest(models)


def map_from_given(request: dict[str, Any]) -> dict[str, Any]:
    """Features and matches with known intrinsics; the largest model of image by image mapping, guided by given poses.

    Where that one leaves out many images, global mapping's model as well: it places more and makes more mistakes.

    One thread in every step: with more, the answer differs from run to run.
    """
    import pycolmap

    work = Path(request["work"])
    database, images = work / "database.db", Path(request["root"])
    pycolmap.set_random_seed(request["seed"])
    extract_with_cameras(request, database, images)
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.compute_relative_pose = True
    verification.min_num_inliers = LEAST_MATCHES
    verification.ransac.random_seed = request["seed"]
    verification.ransac.max_error *= request["error_scale"]
    if request["pairs"] is None:
        pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    else:
        listed = work / "pairs.txt"
        listed.write_text("".join(f"{a} {b}\n" for a, b in request["pairs"]), "utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(listed)
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, verification_options=verification
        )
    drop_contradicting_pairs(database, request["cam_from_world"])
    write_position_priors(database, request["cam_from_world"], request["position_deviation"])

    answer = []
    for mapper, run in (("incremental", map_incrementally), ("global", map_globally)):
        (work / mapper).mkdir()
        models = run(database, images, work / mapper, request)
        if models:
            best = max(models.values(), key=lambda model: model.num_reg_images())
            images_of = describe(best)["images"]
            answer.append({"mapper": mapper, "images": images_of, "points": best.num_points3D()})
            if len(images_of) >= ENOUGH_PLACED * len(request["cam_from_world"]):
                break
    return {"models": answer}


def extract_with_cameras(request: dict[str, Any], database: Path, images: Path) -> None:
    """Features of all images, each with its given intrinsics."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = request["widest_image"]
    extraction.num_threads = 1
    extraction.sift.max_num_features = request["most_features"]
    extraction.sift.peak_threshold = FAINTEST_PEAK
    extraction.sift.domain_size_pooling = extraction.sift.estimate_affine_shape = request["thorough"]
    for camera in request["cameras"]:
        if not camera["names"]:
            continue
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = camera["model"]
        reader.camera_params = ",".join(repr(float(value)) for value in camera["params"])
        pycolmap.extract_features(
            database, images, image_names=camera["names"], camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader, extraction_options=extraction,
        )  # fmt: skip


def drop_contradicting_pairs(database_path: Path, cam_from_world: dict[str, Any]) -> None:
    """Remove pairs whose relative rotation by matches and by given poses differ by far more than most do."""
    import numpy as np
    import pycolmap

    database = pycolmap.Database.open(database_path)
    names = {image.image_id: image.name for image in database.read_all_images()}
    rotation = {name: np.array(pose)[:3, :3] for name, pose in cam_from_world.items()}
    angles = {}
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        if geometry.cam2_from_cam1 is None:
            continue
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matched = geometry.cam2_from_cam1.rotation.matrix()
        given = rotation[names[b]] @ rotation[names[a]].T
        cosine = (np.trace(matched.T @ given) - 1) / 2
        angles[a, b] = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if angles:
        bound = max(PAIR_OUTLIER_DEG, PAIR_OUTLIER * float(np.median(list(angles.values()))))
        for (a, b), angle in angles.items():
            if angle > bound:
                database.delete_two_view_geometry(a, b)
    database.close()


def write_position_priors(database_path: Path, cam_from_world: dict[str, Any], deviation: float) -> None:
    """Given camera centres as priors of this standard deviation."""
    import numpy as np
    import pycolmap

    database = pycolmap.Database.open(database_path)
    for image in database.read_all_images():
        pose = np.array(cam_from_world[image.name])
        prior = pycolmap.PosePrior()
        prior.position = -pose[:3, :3].T @ pose[:3, 3]
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        prior.position_covariance = np.eye(3) * deviation**2
        prior.corr_data_id = image.data_id
        database.write_pose_prior(prior)
    database.close()


def map_incrementally(database: Path, images: Path, work: Path, request: dict[str, Any]) -> dict[int, Any]:
    """Models by adding image to image, with position priors; few matches suffice, as images may be small."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = request["seed"], 1
    options.min_model_size, options.min_num_matches = 3, 10
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.use_prior_position = options.use_robust_loss_on_prior_position = True
    mapper, scale = options.mapper, request["error_scale"]
    mapper.init_min_num_inliers, mapper.abs_pose_min_num_inliers = 3 * LEAST_SEEN, LEAST_SEEN
    mapper.init_min_tri_angle, mapper.max_reg_trials = 8.0, 6
    mapper.init_max_error *= scale
    mapper.abs_pose_max_error *= scale
    mapper.filter_max_reproj_error *= scale
    return pycolmap.incremental_mapping(database, images, work, options)


def map_globally(database: Path, images: Path, work: Path, request: dict[str, Any]) -> dict[int, Any]:
    """Models by averaging all pairs' rotations, then placing all cameras at once."""
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = request["seed"], 1
    options.mapper.random_seed, options.mapper.num_threads = request["seed"], 1
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = (
        False
    )
    return pycolmap.global_mapping(database, images, work, options)


def describe_largest(models: dict[int, Any]) -> dict[str, Any]:
    """Cameras and poses of the model with most images, and the sizes of all models."""
    ordered = sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
    if not ordered:
        return {"cameras": {}, "images": [], "sizes": []}
    return {**describe(ordered[0]), "sizes": [model.num_reg_images() for model in ordered]}


def describe(best: Any) -> dict[str, Any]:
    """Cameras and poses of one model."""
    cameras = {
        str(number): {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
        }
        for number, camera in best.cameras.items()
    }
    images = []
    for image in best.images.values():
        if image.has_pose:
            images.append(
                {
                    "name": image.name,
                    "camera": str(image.camera_id),
                    "cam_from_world": image.cam_from_world().matrix().tolist(),
                }
            )
    return {"cameras": cameras, "images": images}


if __name__ == "__main__":
    main(Path(sys.argv[1]))

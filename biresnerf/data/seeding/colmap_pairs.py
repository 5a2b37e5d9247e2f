"""COLMAP's matches of image pairs, in the child process: found, counted, and held against given poses."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.seeding.seeding_progress import PAIRS

# Features of a photo that show which pairs are likely, and COLMAP's ratio.
COARSEST, NEAREST_TO_NEXT = 256, 0.8
LEAST_MATCHES = 12  # of a pair; small photos have few, COLMAP asks for more
PAIRS_AT_ONCE = 2000  # between two copies of the database
PAIR_OUTLIER = 3.0  # median disagreements beyond which a pair's matches are taken for repeated structure
PAIR_OUTLIER_DEG = 30.0  # but not below this
# Matches nearer than this, px at the size at which COLMAP's bounds hold, stay where they are (COLMAP's default). Of a
# scene that moves, eight times as many move by a third of it to all of it as by less; of something that stands still,
# nearly none do. Beside a moving camera at most 0.4 % of the pairs show both (sixteen sets), before a still one 98 %.
STILL_PX, INNER, FEWEST_STILL, STILL_PAIRS = 4.0, 1 / 3, 8, 0.1


def match_features(
    request: dict[str, Any], database: Path, work: Path, after_some: Callable[[], None] = lambda: None
) -> None:
    """Matches of all pairs, or of those listed, and the relative poses they support.

    Or of the likeliest of these, where the request says how many of each photo. Pairs that are matched already stay as
    they are; ``after_some`` is called now and then.
    """
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = request["threads"]
    verification = verification_options(request)
    pairs = request["pairs"]
    if request["likeliest"] is not None:
        pairs = likeliest_pairs(database, pairs, request["likeliest"])
    if pairs is None:
        names = [name for camera in request["cameras"] for name in camera["names"]]
        pairs = list(combinations(sorted(names), 2))
    listed, some = work / PAIRS, work / "some_pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), "utf-8")
    for first in range(0, len(pairs), PAIRS_AT_ONCE):
        some.write_text("".join(f"{a} {b}\n" for a, b in pairs[first : first + PAIRS_AT_ONCE]), "utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(some)
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, verification_options=verification
        )
        after_some()


def verification_options(request: dict[str, Any]) -> Any:
    """How matches of a pair must fit one motion: pycolmap's options."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.compute_relative_pose = True
    verification.min_num_inliers = LEAST_MATCHES
    verification.ransac.random_seed = request["seed"]
    verification.ransac.max_error *= request["error_scale"]
    return verification


def leave_out_still(request: dict[str, Any], database_path: Path) -> bool:
    """Verify again without matches that stay where they are, if many pairs show both such ones and others.

    Then an object was turned before a still backdrop, or all photos carry the same writing: two motions in a pair.
    """
    import pycolmap

    within = STILL_PX * request["error_scale"]
    with pycolmap.Database.open(database_path) as database:
        at = {
            image.image_id: np.asarray(database.read_keypoints(image.image_id), np.float64)[:, :2]
            for image in database.read_all_images()
        }
        shown = []
        for pair, matches in zip(*database.read_all_matches(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            if len(matches) >= LEAST_MATCHES:
                shown.append(two_motions(at[a][matches[:, 0]], at[b][matches[:, 1]], within))
        if not shown or np.mean(shown) < STILL_PAIRS:
            return False
        database.clear_two_view_geometries()
    options = verification_options(request)
    options.filter_stationary_matches, options.stationary_matches_max_error = True, within
    pycolmap.geometric_verification(database_path, two_view_geometry_options=options)
    return True


def two_motions(xy_in_a: NDArray[np.float64], xy_in_b: NDArray[np.float64], within: float) -> bool:
    """Whether of a pair's matches [n, 2] some stay where they are and others move by more than ``within`` px."""
    moved = np.linalg.norm(xy_in_a - xy_in_b, axis=1)
    still, little = (moved < INNER * within).sum(), ((moved >= INNER * within) & (moved < within)).sum()
    return bool(still > little and still >= FEWEST_STILL and (moved >= within).sum() >= FEWEST_STILL)


def likeliest_pairs(
    database_path: Path, among: list[tuple[str, str]] | None, count: int
) -> list[tuple[str, str]]:
    """Of the pairs (all, if not given) the `count` of each photo whose coarsest features match best.

    Poses are not used, as the given ones may be wrong. After preemptive matching (Wu, Towards linear-time incremental
    structure from motion, 3DV 2013).
    """
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        names = [image.name for image in images]
        coarsest = [_coarsest_descriptors(database, image.image_id) for image in images]
    index = {name: i for i, name in enumerate(names)}
    pairs = combinations(range(len(names)), 2) if among is None else ((index[a], index[b]) for a, b in among)
    matches = np.full((len(names), len(names)), -1)
    for a, b in pairs:
        matches[a, b] = matches[b, a] = _mutual_matches(coarsest[a] @ coarsest[b].T)
    chosen = set()
    for i, row in enumerate(matches):
        best = np.argsort(-row, kind="stable")[:count]
        chosen |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] >= 0}
    return [(names[a], names[b]) for a, b in sorted(chosen)]


def _coarsest_descriptors(database: Any, image: int) -> NDArray[np.float32]:
    """Unit descriptors [k, 128] of an image's features of the largest scales."""
    shapes = np.asarray(database.read_keypoints(image), np.float32)[:, 2:6]
    descriptors = np.asarray(database.read_descriptors(image).data, np.float32)
    areas = np.abs(shapes[:, 0] * shapes[:, 3] - shapes[:, 1] * shapes[:, 2])
    found = descriptors[np.argsort(-areas, kind="stable")[:COARSEST]]
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9), np.float32)


def _mutual_matches(cosines: NDArray[np.float32]) -> int:
    """How many features are each other's nearest, and nearer by Lowe's ratio than the next, by cosines [k, l]."""
    if min(cosines.shape) < 2:
        return 0
    rows = np.arange(len(cosines))
    nearest = cosines.argmax(1)
    mutual = cosines.argmax(0)[nearest] == rows
    angle, next_angle = np.arccos(np.clip(-np.partition(-cosines, 1, axis=1)[:, :2].T, -1, 1))
    return int((mutual & (angle < NEAREST_TO_NEXT * next_angle)).sum())


def matched_pairs(database_path: Path) -> list[tuple[str, str, int]]:
    """Names of the images of each pair that matches, and how many matches."""
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        verified = list(zip(*database.read_two_view_geometries(), strict=True))
    pairs = ((*pycolmap.pair_id_to_image_pair(pair), len(found.inlier_matches)) for pair, found in verified)
    return [(names[a], names[b], count) for a, b, count in pairs if count >= LEAST_MATCHES]


def drop_contradicting_pairs(database_path: Path, cam_from_world: dict[str, Any]) -> None:
    """Remove pairs whose relative rotation by matches and by given poses differ by far more than most do."""
    import pycolmap

    from biresnerf.geometry.pose_error import rotation_between_deg

    database = pycolmap.Database.open(database_path)
    names = {image.image_id: image.name for image in database.read_all_images()}
    rotation = {name: np.array(pose)[:3, :3] for name, pose in cam_from_world.items()}
    angles = {}
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        if geometry.cam2_from_cam1 is None or names[a] not in rotation or names[b] not in rotation:
            continue
        matched = geometry.cam2_from_cam1.rotation.matrix()
        given = rotation[names[b]] @ rotation[names[a]].T
        angles[a, b] = float(rotation_between_deg(matched, given))
    if angles:
        bound = max(PAIR_OUTLIER_DEG, PAIR_OUTLIER * float(np.median(list(angles.values()))))
        for (a, b), angle in angles.items():
            if angle > bound:
                database.delete_two_view_geometry(a, b)
    database.close()


def write_position_priors(database_path: Path, cam_from_world: dict[str, Any], deviation: float) -> None:
    """Given camera centres as priors of this standard deviation, in the place of those that COLMAP read from EXIF.

    Its GPS positions lie in another frame than given poses, and its gravity is only as good as the photographer's
    hand: the tag that says which way is up knows quarter turns.
    """
    import pycolmap

    database = pycolmap.Database.open(database_path)
    database.clear_pose_priors()
    for image in database.read_all_images():
        if image.name not in cam_from_world:
            continue
        pose = np.array(cam_from_world[image.name])
        prior = pycolmap.PosePrior()
        prior.position = -pose[:3, :3].T @ pose[:3, 3]
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        prior.position_covariance = np.eye(3) * deviation**2
        prior.corr_data_id = image.data_id
        database.write_pose_prior(prior)
    database.close()

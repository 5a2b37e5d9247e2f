"""COLMAP's matches of image pairs, in the child process: found, counted, and held against given poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

LEAST_MATCHES = 12  # of a pair; small photos have few, COLMAP asks for more
PAIR_OUTLIER = 3.0  # median disagreements beyond which a pair's matches are taken for repeated structure
PAIR_OUTLIER_DEG = 30.0  # but not below this


def match_features(request: dict[str, Any], database: Path, work: Path) -> None:
    """Matches of all pairs, or of those listed, and the relative poses they support."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = request["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.compute_relative_pose = True
    verification.min_num_inliers = LEAST_MATCHES
    verification.ransac.random_seed = request["seed"]
    verification.ransac.max_error *= request["error_scale"]
    if request["pairs"] is None:
        pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
        return
    listed = work / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in request["pairs"]), "utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=pairing, verification_options=verification
    )


def matched_pairs(database_path: Path) -> list[tuple[str, str, int]]:
    """Names of the images of each pair that matches, and how many matches."""
    import pycolmap

    database = pycolmap.Database.open(database_path)
    names = {image.image_id: image.name for image in database.read_all_images()}
    found = []
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        if len(geometry.inlier_matches) >= LEAST_MATCHES:
            a, b = pycolmap.pair_id_to_image_pair(pair)
            found.append((names[a], names[b], len(geometry.inlier_matches)))
    database.close()
    return found


def drop_contradicting_pairs(database_path: Path, cam_from_world: dict[str, Any]) -> None:
    """Remove pairs whose relative rotation by matches and by given poses differ by far more than most do."""
    import numpy as np
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
    """Given camera centres as priors of this standard deviation."""
    import numpy as np
    import pycolmap

    database = pycolmap.Database.open(database_path)
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

"""COLMAP on a set, in a separate process: ``python -m benchmarks.field.colmap_child REQUEST.json``.

`place` maps the photos twice from the same matches: with COLMAP's defaults, and with richer lenses, whose model stands
in for a missing truth. `measure` tests any model against the matches, to which both of COLMAP's were fitted.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

KEPT = 400  # matches of a pair, at most
CLOSE_PX = 2.0

Array = NDArray[np.float64]


def place(request: dict[str, Any]) -> dict[str, Any]:
    """Two models of one set of features and matches, in the folder ``work``, and the matches themselves.

    `peer` is COLMAP with its own defaults. `reference` has lenses of four distortion terms, and starts from those of
    the peer.
    """
    import pycolmap

    work, root = Path(request["work"]), Path(request["root"])
    database, began = work / "database.db", time.monotonic()
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(database, root, image_names=request["names"])
    pycolmap.match_exhaustive(database)
    matched_s = time.monotonic() - began
    answer: dict[str, Any] = {"peer": _mapped(database, root, work / "peer")}
    answer["peer"]["seconds"] += matched_s
    if answer["peer"]["placed"]:
        _widen_lenses(database, work / "peer")
        answer["reference"] = _mapped(database, root, work / "reference")
    np.savez_compressed(work / "matches.npz", **_verified(database))
    return answer


def _mapped(database: Path, root: Path, folder: Path) -> dict[str, Any]:
    """The model with most photos of incremental mapping, in ``folder``/best."""
    import pycolmap

    began = time.monotonic()
    (folder / "models").mkdir(parents=True)
    models = pycolmap.incremental_mapping(database, root, folder / "models")
    seconds = time.monotonic() - began
    if not models:
        return {"placed": 0, "models": 0, "seconds": seconds}
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    (folder / "best").mkdir()
    best.write(folder / "best")
    return {
        "placed": best.num_reg_images(),
        "models": len(models),
        "reprojection_px": best.compute_mean_reprojection_error(),
        "seconds": seconds,
        "frames": _frames(best),
    }


def _widen_lenses(database: Path, peer: Path) -> None:
    """Converts the database's cameras to OPENCV, with the peer's focal length and first distortion term."""
    import pycolmap

    found = pycolmap.Reconstruction(peer / "best").cameras
    opened = pycolmap.Database.open(database)
    for number, known in found.items():
        camera = opened.read_camera(number)
        focal, x, y, radial = known.params  # COLMAP's default model is SIMPLE_RADIAL
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [focal, focal, x, y, radial, 0.0, 0.0, 0.0]
        opened.update_camera(camera)
    opened.close()


def _frames(model: Any) -> list[dict[str, Any]]:
    """Name, world_from_cam [4, 4] and lens of each placed photo."""
    frames = []
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        camera = model.cameras[image.camera_id]
        lens = {
            "model": camera.model.name, "width": camera.width, "height": camera.height, "params": list(camera.params)
        }  # fmt: skip
        frames.append({"name": image.name, "world_from_cam": pose.tolist(), "lens": lens})
    return frames


def _verified(path: Path) -> dict[str, Any]:
    """Matches that fit one epipolar geometry: names [p, 2], rows of each pair, xy [m, 4] (px as stored)."""
    import pycolmap

    database = pycolmap.Database.open(path)
    names = {image.image_id: image.name for image in database.read_all_images()}
    xy = {number: database.read_keypoints(number)[:, :2] for number in names}
    rng = np.random.default_rng(0)
    pairs, counts, rows = [], [], []
    ids, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(ids, geometries, strict=True):
        matches = geometry.inlier_matches
        if len(matches) == 0:
            continue
        first, second = pycolmap.pair_id_to_image_pair(pair)
        chosen = matches[rng.permutation(len(matches))[:KEPT]]
        pairs.append((names[first], names[second]))
        counts.append(len(chosen))
        rows.append(np.hstack([xy[first][chosen[:, 0]], xy[second][chosen[:, 1]]]))
    database.close()
    return {
        "pairs": np.array(pairs).reshape(-1, 2),
        "counts": np.array(counts, dtype=np.int64),
        "xy": np.concatenate(rows) if rows else np.empty((0, 4)),
    }


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """How well COLMAP's matches fit a model: the median symmetric epipolar distance, px of the full photo."""
    import pycolmap

    if not Path(request["model"]).is_dir():
        return {"epipolar_px": None, "close": None, "pairs": 0}
    model = pycolmap.Reconstruction(request["model"])
    images = {Path(image.name).name: image for image in model.images.values() if image.has_pose}
    kept = np.load(request["matches"])
    starts = np.concatenate([[0], np.cumsum(kept["counts"])])
    distances, pairs = [], 0
    for k, (first, second) in enumerate(kept["pairs"]):
        one, other = images.get(Path(first).name), images.get(Path(second).name)
        if one is None or other is None:
            continue
        pairs += 1
        rows = kept["xy"][starts[k] : starts[k + 1]]
        lenses = model.cameras[one.camera_id], model.cameras[other.camera_id]
        rays = [_rays(lens, rows[:, at : at + 2]) for lens, at in zip(lenses, (0, 2), strict=True)]
        between = other.cam_from_world() * one.cam_from_world().inverse()
        focal = np.mean([lens.mean_focal_length() for lens in lenses])
        distances.append(focal * epipolar(between.rotation.matrix(), between.translation, *rays))
    if not distances:
        return {"epipolar_px": None, "close": None, "pairs": 0}
    off = np.nan_to_num(np.concatenate(distances), nan=np.inf)  # COLMAP's lenses do not see all pixels
    return {
        "epipolar_px": float(np.median(off)),
        "close": float((off < CLOSE_PX).mean()),
        "pairs": pairs,
    }


def epipolar(rotation: Array, translation: Array, one: Array, other: Array) -> Array:
    """Symmetric epipolar distances [m] of rays (x, y, 1) [m, 3] in two cameras, ``other_from_one``, at focal length 1.

    Infinite where the cameras coincide, which fits any ray.
    """
    length = np.linalg.norm(translation)
    if length < 1e-12:
        return np.full(len(one), np.inf)
    x, y, z = translation / length
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    lines_there, lines_here = one @ essential.T, other @ essential
    off = np.abs((other * lines_there).sum(1))
    here, there = np.linalg.norm(lines_here[:, :2], axis=1), np.linalg.norm(lines_there[:, :2], axis=1)
    return np.asarray((off / np.maximum(here, 1e-12) + off / np.maximum(there, 1e-12)) / 2)


def _rays(lens: Any, xy: Array) -> Array:
    return np.hstack([np.asarray(lens.cam_from_img(xy)), np.ones((len(xy), 1))])


if __name__ == "__main__":
    asked = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    done = {"place": place, "measure": measure}[asked["step"]](asked)
    Path(asked["answer"]).write_text(json.dumps(done), "utf-8")

"""Models of a set of images by their feature matches: COLMAP, with the intrinsics and the poses there are."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_distances import nearest_pairs, pose_distances
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.photos.alike.image_likeness import unlikeness
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.image_files import is_plain, quiet_pillow
from biresnerf.data.photos.images import decoding_threads
from biresnerf.data.photos.masks import write_masks
from biresnerf.data.points.tracks import KEPT, keep_tracks
from biresnerf.data.seeding.colmap_child import DATABASE
from biresnerf.data.seeding.colmap_process import run_colmap
from biresnerf.data.seeding.seeding_progress import OnSeeding, SeedingWatch
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.camera.lens import lens_problem
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_robust
from biresnerf.options.refine_options import SeedingEffort

# Images whose poses are given; beyond it, each is matched with those whose given poses see most nearly the same.
GUIDED_ALL_PAIRS_UP_TO = 60
NEIGHBOURS = 40
ALL_PAIRS_UP_TO = 150  # images of which some have no pose (11 000 pairs)
# Beyond it each is matched with its neighbours by name, and with those that look most alike: loops close there.
BY_NAME, BY_LIKENESS = 12, 10
# Standard deviation of given positions, of the cameras' distance: holds what matches leave open (the drift of narrow
# views, the mirror of flat scenes) and, under a robust loss, no more.
POSITION_DEVIATION = 0.2
# Of all these, each photo's best by a few features are matched where poses are given. More cost time alone: adjusted to
# the tracks of 12 for each (of all), temple is off by 0.085 deg (0.092), fox by 0.050 (0.062), at 0.3 of the work.
LIKELIEST = 12
CHOSEN_ONCE = 0.55  # of the pairs that each photo chooses, those that are counted once
# Long side, px, at which features are looked for; where poses are given so large that all photos have so many pixels,
# three minutes of one core.
NARROWEST_IMAGE, WIDEST_IMAGE, PIXELS = 1000, 1600, 6e7
# Of a photo, at most. Matching compares the features of each pair: as many are allowed as take a minute of one core.
# COLMAP leaves out the finest first, which are the most exact: fountain-P11 (768 px), adjusted to the tracks of 2048,
# ends at 0.056 deg, of 8192 at 0.029 (`benchmarks.method.features`).
COMPARISONS = 1.3e10
FEWEST_FEATURES, FEWEST_ALONE, MOST_FEATURES = 2048, 4096, 8192
# COLMAP's bounds on reprojection errors are made for photos of thousands of px. At 200 px they let wrong matches pass:
# with 0.35 of them temple's mean rotation error went from 6.8 to 1.4 deg, entry-P10's from 4.9 to 0.8.
ERROR_SIZE = 1600  # px, long side at which COLMAP's own bounds hold; they shrink with the root of the size
# Where memory is short.
WIDEST_LOW, MOST_FEATURES_LOW = 800, 1024
# Small photos have few features. Affine shapes and pooled scales then place more cameras, and cost three times as much;
# from 400 px on they rarely gain anything. In px, of the long side and of all photos.
THOROUGH_BELOW, THOROUGH_UP_TO = 400, 10e6

PARTS = "parts"  # the mapper of a model that was joined from a set's parts
# Photos that have poses. COLMAP adjusts more than 1,000 iteratively: 1,177 took nine minutes, once of many times. Left
# unadjusted, 3,000 drift by 17 m. The run adjusts all cameras to the matches in any case.
POSED_MAPPED_UP_TO = 1000
COPY_EVERY_S = 60.0  # of features and matches, for a run that is killed
_QUICKLY = 1  # PNG's compression of photos that are written for COLMAP, and removed after


@dataclass(frozen=True, eq=False)
class MappedModel:
    """The model that one way of mapping made of the images, in its own frame and scale.

    Attributes:
        mapper: ``incremental``, ``global`` or ``parts``.
        rows: indices [m] of the images it places.
        world_from_cam: float64 [m, 4, 4].
        cameras: by index in the set, those that see any of them; known intrinsics as they were.
        points: how many points the matches made.
        observations: in how many images, in sum.
        reprojection_px: mean distance of the points from their features.
    """

    mapper: str
    rows: NDArray[np.int64]
    world_from_cam: NDArray[np.float64]
    cameras: dict[int, Camera]
    points: int
    observations: int
    reprojection_px: float


@dataclass(frozen=True, eq=False)
class Mapping:
    """What COLMAP made of a set.

    Attributes:
        models: the best first.
        matches: pairs of images, and how many features they have in common [m, 3].
        still: whether matches were left out that stay where they are while others move.
    """

    models: tuple[MappedModel, ...]
    matches: NDArray[np.int64]
    still: bool


class AskMatches(Protocol):
    """What answers as `ask_colmap` does: COLMAP itself, or what was found of a set's parts."""

    def __call__(
        self,
        dataset: Dataset,
        *,
        should_stop: Callable[[], bool],
        seed: int,
        effort: SeedingEffort,
        limit_s: float,
        log_folder: Path | None,
        kept: Path | None,
        on_progress: OnSeeding,
    ) -> dict[str, Any]: ...


def known_intrinsics(dataset: Dataset) -> list[bool]:
    """Whether each camera's intrinsics are the user's own or their maker's, which COLMAP then leaves alone."""
    if not dataset.intrinsics_sources:
        return [True] * len(dataset.cameras)
    return [source in ("given", "maker") for source in dataset.intrinsics_sources]


def ask_colmap(
    dataset: Dataset,
    *,
    should_stop: Callable[[], bool],
    seed: int,
    effort: SeedingEffort,
    limit_s: float,
    log_folder: Path | None = None,
    kept: Path | None = None,
    on_progress: OnSeeding = lambda _found: None,
) -> dict[str, Any]:
    """What COLMAP finds, as plain data for `read_mapping`. Poses that the set has guide it.

    Beside the log in ``log_folder`` the tracks are left, for `Tracks.load`, also where mapping took too long. The file
    ``kept`` holds what is found of features and matches, for a run that goes on after it was killed. One thread maps
    where all poses are given: more would make the answer differ from run to run. With low effort, one also looks for
    features and matches: each takes memory.

    Raises:
        InputError: ``seed_timeout``, or a code of `open_image`.
        Interrupted: ``should_stop`` returned true.
        RefinementError: ``seeding_crashed``.
    """
    low = effort == "low"
    with tempfile.TemporaryDirectory(prefix="biresnerf-colmap-") as work:
        request = {
            **lay_out(dataset, Path(work)),
            "answer": str(Path(work, "answer.json")),
            "kept": None if kept is None else str(kept),
            "copy_every_s": COPY_EVERY_S,
            "seed": seed,
            "threads": 1 if low else -1,
            "maps": is_mapped(dataset),
            "mapping_threads": 1 if low or dataset.posed.all() else -1,
        }
        pairs = pair_count(dataset, request["pairs"])
        request |= thoroughness(dataset, effort, pairs)
        if request["likeliest"] is not None:
            pairs = min(pairs, chosen_pairs(len(dataset), request["likeliest"]))
        watch = SeedingWatch(Path(work, DATABASE), pairs, on_progress, kept)
        try:
            return run_colmap(request, Path(work), should_stop, limit_s, log_folder, watch.look)
        finally:
            if log_folder is not None:
                keep_tracks(Path(work), dataset.names, log_folder / KEPT)


def lay_out(dataset: Dataset, work: Path) -> dict[str, Any]:
    """The photos and masks in the folder ``work``, and what COLMAP may know of them: cameras, poses, pairs."""
    names, masks = numbered_names(dataset), work / "masks"
    _link_photos(dataset, names, work / "photos")
    return {
        "set": str(dataset.root),
        "root": str(work / "photos"),
        "masks": str(masks) if write_masks(dataset, names, masks) else None,
        "work": str(work),
        **_request_images(dataset, names),
    }


def numbered_names(dataset: Dataset) -> list[str]:
    """COLMAP's list of pairs knows no spaces, so photos go by numbers there."""
    suffixes = (f.path.suffix if _as_it_is(dataset, i) else ".png" for i, f in enumerate(dataset.frames))
    return [f"{i:06}{suffix}" for i, suffix in enumerate(suffixes)]


def _rigs(dataset: Dataset, names: list[str]) -> list[list[list[tuple[str, list[list[float]]]]]]:
    """For the panoramas of each size, each one's views: names, and rotations [3, 3] to them from the panorama."""
    if dataset.cut is None:
        return []
    cut = dataset.cut
    views = [(name, turn[:3, :3].tolist()) for name, turn in zip(names, cut.cam_from_whole, strict=True)]
    rigs: dict[int, list[list[tuple[str, list[list[float]]]]]] = {}
    for row, frame in enumerate(cut.whole.frames):
        if cut.whole.cameras[frame.camera].panorama:
            moment = [views[i] for i in np.flatnonzero(cut.rows == row)]
            rigs.setdefault(frame.camera, []).append(moment)
    return list(rigs.values())


def _as_it_is(dataset: Dataset, index: int) -> bool:
    """Whether COLMAP takes the file itself: it reads plain photos, and takes their pixels as they are stored."""
    frame = dataset.frames[index]
    stored = frame.orientation == 1 and not dataset.camera_of(index).shear and frame.levels is None
    return stored and is_plain(frame.path, frame.name)


def _link_photos(dataset: Dataset, names: list[str], folder: Path) -> None:
    folder.mkdir()
    plain = [_as_it_is(dataset, index) for index in range(len(dataset))]

    def lay(index: int) -> None:
        name, frame = names[index], dataset.frames[index]
        if plain[index]:
            (folder / name).symlink_to(frame.path.resolve())
        else:
            photo = Image.fromarray(decode(frame, dataset.camera_of(index)))
            photo.save(folder / name, compress_level=_QUICKLY)

    with quiet_pillow(), ThreadPoolExecutor(decoding_threads(dataset), thread_name_prefix="lay-out") as pool:
        list(pool.map(lay, range(len(dataset))))


def _request_images(dataset: Dataset, names: list[str]) -> dict[str, Any]:
    posed, known = dataset.posed, known_intrinsics(dataset)
    given = np.stack(
        [f.world_from_cam for f in dataset.frames if f.world_from_cam is not None] or [np.eye(4)]
    )
    posed_names = [name for name, has in zip(names, posed, strict=True) if has]
    guessed = [source == "guessed" for source in dataset.intrinsics_sources] or [False] * len(known)
    return {
        "cameras": [
            {
                "model": camera.model,
                "params": None if guessed[i] else list(camera.params),
                "known": known[i],
                "names": [n for n, f in zip(names, dataset.frames, strict=True) if f.camera == i],
            }
            for i, camera in enumerate(dataset.cameras)
        ],
        "cam_from_world": dict(zip(posed_names, np.linalg.inv(given).tolist(), strict=False)),
        "position_deviation": POSITION_DEVIATION * focus_point(given).mean_distance,
        "pairs": _pairs(dataset, names),
        "rigs": _rigs(dataset, names),
    }


def thoroughness(dataset: Dataset, effort: SeedingEffort, count: float) -> dict[str, Any]:
    """How large photos are and how many features are looked for where so many pairs are matched."""
    sizes = [dataset.camera_of(i) for i in range(len(dataset))]
    low, guided = effort == "low", dataset.posed.all()
    side = (PIXELS * 4 / 3 / len(dataset)) ** 0.5  # of photos of 4 to 3
    # Where nothing else says where photos were taken, more is spent.
    most = (
        WIDEST_LOW if low else int(np.clip(side, NARROWEST_IMAGE, WIDEST_IMAGE)) if guided else WIDEST_IMAGE
    )
    widest = min(most, float(np.median([max(c.width, c.height) for c in sizes])))
    fewest = FEWEST_FEATURES if guided else FEWEST_ALONE
    features = int(np.clip((COMPARISONS / max(1, count)) ** 0.5, fewest, MOST_FEATURES))
    return {
        "widest_image": most,
        "most_features": MOST_FEATURES_LOW if low else features,
        "error_scale": min(1.0, (widest / ERROR_SIZE) ** 0.5),
        "likeliest": LIKELIEST if guided else None,
        "thorough": not low
        and widest < THOROUGH_BELOW
        and sum(c.width * c.height for c in sizes) <= THOROUGH_UP_TO,
    }


def is_mapped(dataset: Dataset) -> bool:
    """Whether COLMAP builds a model of the matches, or only finds them."""
    return not dataset.posed.all() or len(dataset) <= POSED_MAPPED_UP_TO


def chosen_pairs(count: int, each: int) -> int:
    """About how many pairs there are if each of so many photos chooses `each` others."""
    return round(CHOSEN_ONCE * count * each)


def pair_count(dataset: Dataset, pairs: list[tuple[str, str]] | None) -> int:
    """How many pairs are matched, all of them where none are named."""
    return len(dataset) * (len(dataset) - 1) // 2 if pairs is None else len(pairs)


def _pairs(dataset: Dataset, names: list[str]) -> list[tuple[str, str]] | None:
    """The pairs worth matching, None for all of them."""
    if len(names) <= (GUIDED_ALL_PAIRS_UP_TO if dataset.posed.all() else ALL_PAIRS_UP_TO):
        return None
    return [(names[i], names[j]) for i, j in sorted(likely_pairs(dataset))]


def likely_pairs(dataset: Dataset) -> set[tuple[int, int]]:
    """Pairs of photos, by row, that may show the same: by given poses where all have one, else by looks and names."""
    if dataset.posed.all():
        return nearest_pairs(pose_distances(dataset.world_from_cam), len(dataset), NEIGHBOURS)
    pairs = nearest_pairs(unlikeness(dataset), len(dataset), BY_LIKENESS)
    order = natural_order(dataset.names)
    for step in range(1, BY_NAME + 1):
        pairs |= {(min(a, b), max(a, b)) for a, b in zip(order, order[step:], strict=False)}
    return pairs


def read_mapping(dataset: Dataset, answer: dict[str, Any]) -> Mapping:
    """`ask_colmap`'s answer for this set, best model first: by images placed, then by features explained, and how well.

    On lego with noisy poses (200 px) both ways of mapping place all; global mapping explains more features, with 1.5
    times the error, and its poses are off by 1.5 times as much.
    """
    index = {name: i for i, name in enumerate(numbered_names(dataset))}
    models = [_model(model, index) for model in answer["models"]]
    matches = [(index[a], index[b], count) for a, b, count in answer["matches"]]
    best_first = sorted(models, key=lambda m: (-len(m.rows), -m.observations / max(m.reprojection_px, 0.1)))
    return Mapping(tuple(best_first), np.array(matches, np.int64).reshape(-1, 3), answer.get("still", False))


def _model(found: dict[str, Any], index: dict[str, int]) -> MappedModel:
    rows = np.array([index[image["name"]] for image in found["images"]], dtype=np.int64)
    model_from_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    for pose, image in zip(model_from_cam, found["images"], strict=True):
        cam_from_model = np.array(image["cam_from_world"])
        pose[:3, :3] = cam_from_model[:, :3].T
        pose[:3, 3] = -cam_from_model[:, :3].T @ cam_from_model[:, 3]
    cameras = {
        int(i): Camera(c["model"], c["width"], c["height"], tuple(c["params"]))
        for i, c in found["cameras"].items()
    }
    return MappedModel(
        found["mapper"], rows, model_from_cam, cameras,
        int(found["points"]), int(found["observations"]), float(found["reprojection_px"]),
    )  # fmt: skip


SAME_DEG = 2.0  # models whose cameras differ by less (median) say the same


def adds_to(best: MappedModel, other: MappedModel) -> bool:
    """Whether a model has other images than the best one, or other rotations, seen through the same lenses."""
    if not _same_lenses(best, other):
        return False
    shared, at, there = np.intersect1d(best.rows, other.rows, return_indices=True)
    if len(shared) < len(other.rows):
        return True
    poses = best.world_from_cam[at]
    carried = align_robust(other.world_from_cam[there], poses, with_rotations=True).apply_to_poses(
        other.world_from_cam[there]
    )
    turned = rotation_between_deg(poses, carried)
    return float(np.median(turned)) >= SAME_DEG


def _same_lenses(one: MappedModel, other: MappedModel) -> bool:
    return all(
        i in one.cameras and np.allclose(one.cameras[i].params, camera.params, rtol=1e-3, atol=1e-3)
        for i, camera in other.cameras.items()
    )


def model_lens_problem(dataset: Dataset, model: MappedModel) -> str | None:
    """Why a lens of a model is impossible, as COLMAP finds where the views fix too little; else None."""
    known = known_intrinsics(dataset)
    for i, camera in model.cameras.items():
        problem = None if known[i] else lens_problem(camera.full(), camera.width, camera.height)
        if problem is not None:
            return problem
    return None


def with_found_lenses(dataset: Dataset, models: list[MappedModel]) -> Dataset:
    """The first model's lenses in place of guessed ones."""
    known = known_intrinsics(dataset)
    if not models or all(known):
        return dataset
    cameras, sources = list(dataset.cameras), list(dataset.intrinsics_sources)
    for i, camera in models[0].cameras.items():
        if not known[i]:
            cameras[i], sources[i] = camera, "colmap"
    return replace(dataset, cameras=tuple(cameras), intrinsics_sources=tuple(sources))

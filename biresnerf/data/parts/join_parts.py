"""Join the results of a set's parts to one answer about all of it, in COLMAP's place; and how well the parts agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.result_formats import read_result
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding.colmap_tracks import most_observations
from biresnerf.data.seeding.map_images import PARTS, SAME_DEG, MappedModel, numbered_names
from biresnerf.data.seeding.match_poses import JUDGED_FROM, carry_model
from biresnerf.errors import InputError, RefinementError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.similarity import align_robust
from biresnerf.uncertainty import NOT_REFINED, PartReport, PartsReport, SeamReport

FEW = f"it shares fewer than {JUDGED_FROM} photos with the others"
APART = "photos that it shares with the others have other poses there"
NOTHING = "its photos matched nothing"


@dataclass(frozen=True, eq=False)
class PartResult:
    """What was found of a part.

    Attributes:
        name: of the part.
        model: its poses in its own frame, by rows of the whole set, and its lenses by the whole set's cameras.
        bounds: of each pose, rad and units of the part, [m, 2]: 90 of 100 errors are within; NaN where not known.
        tracks: its points, by rows of the whole set; None where nothing matched.
    """

    name: str
    model: MappedModel
    bounds: NDArray[np.float64]
    tracks: Tracks | None


def read_part(dataset: Dataset, folder: Path) -> PartResult:
    """The result in ``folder`` of some of the set's photos.

    Raises:
        InputError: ``result_missing``, ``part_of_other_set``, or a code of the readers.
    """
    found = read_result(folder)
    rows = [dataset.called(image.name)[:1] for image in found.images]
    if not all(rows):
        name = next(image.name for image, row in zip(found.images, rows, strict=True) if not row)
        raise InputError(
            "part_of_other_set", f"has an image {name!r}, which the set lacks.", where=str(folder),
            hint="Give results of photos of this set.",
        )  # fmt: skip
    row_of = np.array([row[0] for row in rows], np.int64)
    images = zip(row_of.tolist(), found.images, strict=True)
    lenses = {dataset.frames[row].camera: found.cameras[image.camera] for row, image in images}
    tracks, points = _tracks(found, row_of), found.model.points
    errors = points.errors[points.errors >= 0]
    model = MappedModel(
        PARTS, row_of, np.stack([image.world_from_cam for image in found.images]), lenses,
        len(points), len(points.track_image_ids), float(errors.mean()) if len(errors) else 0.0,
    )  # fmt: skip
    known = [image.uncertainty for image in found.images]
    bounds = [
        (np.nan, np.nan) if one is None or one.rotation_deg is None or one.position is None
        else (np.radians(one.rotation_deg), one.position)
        for one in known
    ]  # fmt: skip
    return PartResult(folder.name, model, np.array(bounds), tracks)


def _tracks(found: RefinedSet, row_of: NDArray[np.int64]) -> Tracks | None:
    """The points that features of the photos show."""
    seen = [
        (point, row_of[image], *xy)
        for point, landmark in enumerate(found.landmarks())
        for image, (_, xy) in landmark.seen.items()
    ]
    if not seen:
        return None
    point, row, x, y = np.array(seen).T
    order = np.lexsort((row, point))
    return Tracks.of(point[order], row[order], np.column_stack([x, y])[order])


@dataclass(frozen=True)
class AskParts:
    """Answers about a set as COLMAP does, from the results in these folders, each of a part of it."""

    folders: tuple[Path, ...]

    def __call__(self, dataset: Dataset, *, log_folder: Path | None, **_: Any) -> dict[str, Any]:
        """As `biresnerf.data.seeding.map_images.ask_colmap`.

        Raises:
            InputError: a code of `read_part`.
            RefinementError: ``parts_failed``: none of the parts has a result.
        """
        missing = [
            PartReport.model_validate_json(why.read_bytes())
            for folder in self.folders
            if (why := folder / NOT_REFINED).is_file()
        ]
        refined = [folder for folder in self.folders if not (folder / NOT_REFINED).is_file()]
        if not refined:
            raise RefinementError(
                "parts_failed", f"None of the {len(missing)} parts was refined: {missing[0].why_not}"
            )
        parts = [read_part(dataset, folder) for folder in refined]
        model, report = join(len(dataset), parts)
        if missing:
            every = sorted((*report.parts, *missing), key=lambda part: part.name)
            report = report.model_copy(update={"parts": tuple(every)})
        tracks = joined_tracks([part.tracks for part in parts], len(dataset))
        if tracks is not None and log_folder is not None:
            log_folder.mkdir(parents=True, exist_ok=True)
            with whole_file(log_folder / KEPT) as temporary:
                arrays: dict[str, Any] = tracks.kept()
                np.savez(temporary, names=np.array(dataset.names), **arrays)
        names = numbered_names(dataset)
        return {
            "models": [_answer(model, names)] if len(model.rows) else [],
            "matches": [(names[a], names[b], n) for a, b, n in points_in_common(tracks)],
            "parts": report.model_dump(),
        }


def joined_tracks(tracks: Sequence[Tracks | None], images: int) -> Tracks | None:
    """The tracks of all parts: points that share a feature of a photo are one."""
    pairs = [(one, one.pairs()) for one in tracks if one is not None]
    if not pairs:
        return None
    joined = Tracks.of_matches(
        np.concatenate([np.column_stack([one.image[a], one.image[b]]) for one, (a, b) in pairs]),
        np.concatenate([np.stack([one.xy[a], one.xy[b]], axis=1) for one, (a, b) in pairs]),
    )
    return None if joined is None else joined.thinned(most_observations(images), images)


def join(photos: int, parts: Sequence[PartResult]) -> tuple[MappedModel, PartsReport]:
    """One model of all parts that join, in the frame of the largest, and how well any two of them agree.

    The part that shares the most photos with those before it is next. Of a photo in several parts the pose with the
    smaller bound is taken.
    """
    rig, why_not = _Rig.empty(photos), dict[int, str | None]()
    left = sorted(range(len(parts)), key=lambda k: -len(parts[k].model.rows))
    while left:
        following = max(left, key=lambda k: rig.shared(parts[k]))
        left.remove(following)
        why_not[following] = rig.take(parts[following], following)
    apart_deg = np.full(photos, np.nan)
    joined = [part for k, part in enumerate(parts) if why_not[k] is None]
    seams = [_seam(a, b, apart_deg) for a, b in combinations(joined, 2) if _common(a, b) >= JUDGED_FROM]
    report = PartsReport(
        parts=tuple(
            PartReport(name=part.name, photos=len(part.model.rows), why_not=why_not[k])
            for k, part in enumerate(parts)
        ),
        seams=tuple(seams),
        photos_left_out=int(photos - rig.placed.sum()),
        part_of=tuple(k if k >= 0 else None for k in rig.part.tolist()),
        apart_deg=tuple(None if np.isnan(each) else each for each in apart_deg.tolist()),
    )
    return _one_model(rig, [part.model for part in joined]), report


def _common(a: PartResult, b: PartResult) -> int:
    return len(np.intersect1d(a.model.rows, b.model.rows))


@dataclass(frozen=True, eq=False)
class _Rig:
    """The cameras of the whole set as far as they are joined: poses, which are placed, their bounds (rad) and parts."""

    poses: NDArray[np.float64]
    placed: NDArray[np.bool_]
    bound: NDArray[np.float64]
    part: NDArray[np.int64]

    @classmethod
    def empty(cls, photos: int) -> _Rig:
        poses, of_none = np.tile(np.eye(4), (photos, 1, 1)), np.full(photos, -1)
        return cls(poses, np.zeros(photos, np.bool_), np.full(photos, np.inf), of_none)

    def shared(self, part: PartResult) -> int:
        """How many of the part's photos are placed."""
        return int(self.placed[part.model.rows].sum())

    def take(self, part: PartResult, number: int) -> str | None:
        """Carry a part onto what is there by the photos that both have; or why that cannot be. It is not forced."""
        rows, found = part.model.rows, self.poses.copy()
        if part.tracks is None:
            return NOTHING
        if self.placed.any():
            if self.shared(part) < JUDGED_FROM:
                return FEW
            carried = carry_model(part.model, self.poses, self.placed)
            both = rows[self.placed[rows]]
            if carried is None or _apart_deg(carried.world_from_cam[both], self.poses[both]) > SAME_DEG:
                return APART
            found, trusted = carried.world_from_cam, carried.placed[rows]
        else:
            found[rows], trusted = part.model.world_from_cam, np.ones(len(rows), np.bool_)
        bound = np.nan_to_num(part.bounds[:, 0], nan=np.inf, posinf=np.inf)
        better = trusted & (~self.placed[rows] | (bound < self.bound[rows]))
        taken = rows[better]
        self.poses[taken], self.placed[taken], self.bound[taken] = found[taken], True, bound[better]
        self.part[taken] = number
        return None


def _apart_deg(here: NDArray[np.float64], there: NDArray[np.float64]) -> float:
    """By how much the cameras are turned against each other: the median."""
    return float(np.median(rotation_between_deg(here, there)))


def _one_model(rig: _Rig, models: Sequence[MappedModel]) -> MappedModel:
    """The joined model; of a lens that several parts found, the one of the part with the most photos."""
    lenses: dict[int, Camera] = {}
    for model in sorted(models, key=lambda one: len(one.rows)):
        lenses |= model.cameras
    seen = sum(model.observations for model in models)
    error = sum(model.reprojection_px * model.observations for model in models) / max(1, seen)
    points = sum(model.points for model in models)
    return MappedModel(PARTS, np.flatnonzero(rig.placed), rig.poses[rig.placed], lenses, points, seen, error)


def _seam(a: PartResult, b: PartResult, apart_deg: NDArray[np.float64]) -> SeamReport:
    """How far two parts disagree on the photos that both have, once one is carried onto the other by them.

    ``apart_deg`` [n] of these photos becomes at least what they disagree by.
    """
    rows, in_a, in_b = np.intersect1d(a.model.rows, b.model.rows, return_indices=True)
    there, here = a.model.world_from_cam[in_a], b.model.world_from_cam[in_b]
    a_from_b = align_robust(here, there, with_rotations=True)
    here = a_from_b.apply_to_poses(here)
    turned = rotation_between_deg(here, there)
    shifted = np.linalg.norm(here[:, :3, 3] - there[:, :3, 3], axis=1)
    apart_deg[rows] = np.fmax(apart_deg[rows], turned)
    bounds = np.hypot(a.bounds[in_a], b.bounds[in_b] * [1.0, a_from_b.scale])
    known = np.isfinite(bounds).all(1)
    within = np.column_stack([np.radians(turned), shifted]) <= bounds
    return SeamReport(
        parts=(a.name, b.name),
        photos=len(in_a),
        rotation_deg=float(np.median(turned)),
        rotation_deg_worst=float(turned.max()),
        position=float(np.median(shifted)),
        position_worst=float(shifted.max()),
        within=float(within[known].mean()) if known.any() else None,
    )


def points_in_common(tracks: Tracks | None) -> list[tuple[int, int, int]]:
    """How many points any two photos, by row, have in common."""
    if tracks is None:
        return []
    point, image, keys = tracks.point, tracks.image.astype(np.int64), [np.zeros(0, np.int64)]
    photos, step = int(image.max(initial=0)) + 1, 1
    while (together := point[step:] == point[:-step]).any():
        ends = image[:-step][together], image[step:][together]
        keys.append(np.minimum(*ends) * photos + np.maximum(*ends))
        step += 1
    found, counts = np.unique(np.concatenate(keys), return_counts=True)
    return list(zip((found // photos).tolist(), (found % photos).tolist(), counts.tolist(), strict=True))


def _answer(model: MappedModel, names: Sequence[str]) -> dict[str, Any]:
    """The model as COLMAP's child process writes it."""
    return {
        "mapper": model.mapper,
        "images": [
            {"name": names[row], "cam_from_world": pose[:3].tolist()}
            for row, pose in zip(model.rows.tolist(), rigid_inverse(model.world_from_cam), strict=True)
        ],
        "cameras": {
            str(number): {"model": lens.model, "width": lens.width, "height": lens.height, "params": list(lens.params)}
            for number, lens in model.cameras.items()
        },
        "points": model.points,
        "observations": model.observations,
        "reprojection_px": model.reprojection_px,
    }  # fmt: skip

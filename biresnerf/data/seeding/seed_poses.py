"""Poses to start from: those given, those that feature matches find, and guesses for what neither has."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.model.dataset import GUESSES, Cut, Dataset
from biresnerf.data.model.image_distances import typical_distance
from biresnerf.data.photos.alike.image_likeness import unlikeness
from biresnerf.data.photos.alike.turning_object import turning_notes
from biresnerf.data.photos.named_images import MIN_IMAGES
from biresnerf.data.photos.orientation import shown_from_cam
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.data.seeding.cached_mapping import remembered_mapping
from biresnerf.data.seeding.initial_poses import InitialPoses, even_ring
from biresnerf.data.seeding.map_images import (
    PARTS,
    AskMatches,
    MappedModel,
    Mapping,
    adds_to,
    model_lens_problem,
    with_found_lenses,
)
from biresnerf.data.seeding.match_poses import (
    MatchedPoses,
    can_match,
    carry_model,
    in_measured_frame,
    without_offset,
)
from biresnerf.data.seeding.missing_poses import fill_measured, guess_missing
from biresnerf.data.seeding.seeding_progress import OnSeeding
from biresnerf.errors import FAULTS_RAISE, InputError, RefinementError
from biresnerf.options.refine_options import SeedingEffort, StartPoses
from biresnerf.report import PoseSource

logger = logging.getLogger(__name__)

LEAST_PLACED = 0.6  # of the images; a model of fewer says too little about a rig whose poses are given
LEAST_REGISTERED = 0.4  # of images of which none has a pose; from fewer, the rest cannot be guessed
STILL = (
    "In many pairs of photos some features stay where they are while others move, as behind an object that was turned "
    "before a still camera. Their matches were left out. The optimisation still sees what stands still: mask it, or "
    "photograph before a plain background."
)
# Median likeness of all pairs of photos: from nearly one place 0.56 (LLFF's horns) to 0.87, around a scene 0.1 to 0.66.
FACING_ALIKE = 0.4
MATCHED: dict[str, PoseSource] = {
    "incremental": "matches-incremental", "global": "matches-global", PARTS: "matches-parts",
}  # fmt: skip
BY_GIMBAL = (
    "the cameras begin where GPS and the angles of the drone's gimbal say that they are. How far these are off is not "
    "known, nor how the camera is mounted."
)
OVERLAP_HINT = (
    "Take sharp photos that overlap by more than half, of something with texture, from many places; "
    "or give approximate poses."
)


@dataclass(frozen=True, eq=False)
class Seeding:
    """A set of which every image has a pose, and what to start from.

    Attributes:
        dataset: given poses as they were, missing ones those of the first candidate.
        candidates: one or more; where poses are given, the first are those, completed.
    """

    dataset: Dataset
    candidates: tuple[InitialPoses, ...]


@dataclass(frozen=True, eq=False)
class _Given:
    """The given poses; identity where there is none."""

    dataset: Dataset
    poses: NDArray[np.float64]
    posed: NDArray[np.bool_]

    @classmethod
    def of(cls, dataset: Dataset) -> _Given:
        poses = [np.eye(4) if f.world_from_cam is None else f.world_from_cam for f in dataset.frames]
        return cls(dataset, np.stack(poses), dataset.posed)

    def candidate(
        self, name: PoseSource, matched: MatchedPoses | None, source: PoseSource, matches: NDArray[np.int64]
    ) -> InitialPoses:
        """``matched`` where it placed an image, else the given pose, else by GPS and a gimbal, else a guess."""
        poses = self.poses.copy() if matched is None else matched.world_from_cam.copy()
        placed = np.zeros(len(poses), dtype=np.bool_) if matched is None else matched.placed
        measured = self.measured(poses, placed | self.posed)
        # Photos near each other may have been taken with the camera held level and on its side.
        shown = shown_from_cam(self.dataset.frames)
        upright = poses @ shown.swapaxes(1, 2)
        guessed = guess_missing(
            upright,
            placed | self.posed | measured,
            self.dataset.names,
            matches,
            lambda: unlikeness(self.dataset),
        )
        sources: list[PoseSource] = ["given"] * len(poses)
        for i, guess in enumerate(guessed):
            if guess is not None:
                poses[i] = upright[i] @ shown[i]
            if guess is not None or placed[i]:
                sources[i] = guess or source
            elif measured[i]:
                sources[i] = "gimbal"
        return InitialPoses(poses, name, tuple(sources))

    def measured(self, poses: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Fill in poses [n, 4, 4] by GPS and a gimbal, besides those ``known`` [n]; returns which."""
        if known.all():
            return np.zeros_like(known)
        return fill_measured(poses, known, position_priors(self.dataset))

    def without_matches(self) -> InitialPoses:
        """The given poses, and guesses for the missing ones."""
        return self.candidate("given", None, "given", np.zeros((len(self.poses),) * 2, dtype=np.int64))


def seed_poses(
    dataset: Dataset,
    start: StartPoses = "auto",
    *,
    should_stop: Callable[[], bool] = lambda: False,
    seed: int = 0,
    effort: SeedingEffort = "full",
    remember: Path | None = None,
    on_progress: OnSeeding = lambda _found: None,
    takes_back_offset: bool = True,
    ask: AskMatches | None = None,
) -> Seeding:
    """The set with a pose for every image, and the sets of poses worth starting from.

    ``given`` takes the poses unchanged. ``none`` looks for no features: missing poses are guessed from other
    images. ``auto`` lets features complete the given poses and compete with them; where there are none, COLMAP maps
    the images from scratch, in a frame and scale of its own. ``colmap`` does that in any case and then ties the
    result to the frame of given poses. Images that COLMAP cannot place are where GPS and a drone's gimbal say, or
    guessed. ``turntable`` looks for no features either and puts all images evenly on a level ring, in the order of
    their names.

    COLMAP's threads make its answer differ a little from run to run. A run that is to be continued keeps it in the
    file ``remember``, with colmap.log beside it. ``on_progress`` is called only if
    COLMAP does run: at once, then when more is known. An offset that all given poses share on the camera's side is
    removed first, unless they must not change (``takes_back_offset``). ``ask`` answers in COLMAP's place.

    Raises:
        InputError: ``pose_missing``, ``colmap_missing``, ``seed_failed``, ``insufficient_overlap`` or ``seed_timeout``.
        Interrupted: ``should_stop`` returned true.
        RefinementError: ``seeding_crashed``: COLMAP itself failed, and there are no given poses. Where there are,
            the set that is returned has the fault.
    """
    given = _Given.of(dataset)
    if start == "given" or (start == "none" and given.posed.all()):
        _refuse_missing(dataset)
        return _seeding(dataset, given.without_matches())
    if start == "none":
        return _seeding(dataset, _without_features(given))
    if start == "turntable":
        return _seeding(dataset, even_ring(dataset))
    if ask is None and not can_match():
        return _without_colmap(given, start)
    try:
        mapping = remembered_mapping(
            replace(dataset, frames=tuple(replace(f, world_from_cam=None) for f in dataset.frames))
            if start == "colmap"
            else dataset,
            should_stop, seed, effort, remember, on_progress, ask,
        )  # fmt: skip
    except InputError as error:
        if ask is not None or start == "colmap" or not given.posed.any():
            raise
        warning = f"The given poses could not be compared with feature matches: {error}"
        noted = replace(dataset, warnings=(*dataset.warnings, warning))
        return _seeding(noted, given.without_matches())
    except RefinementError as error:
        if start == "colmap" or not given.posed.any() or os.environ.get(FAULTS_RAISE):
            raise
        logger.error("%s The run goes on without feature matches.", error.fault)
        return _seeding(replace(dataset, faults=(*dataset.faults, error.fault)), given.without_matches())
    if mapping.still:
        given = _Given.of(replace(dataset, warnings=(*dataset.warnings, STILL)))
    if takes_back_offset:
        given = _Given.of(without_offset(given.dataset, mapping.models))
    if start == "auto" and given.posed.any():
        return _beside_given(given, mapping)
    return _from_scratch(given, mapping, start)


def _refuse_missing(dataset: Dataset) -> None:
    missing = [f.name for f in dataset.frames if f.world_from_cam is None]
    if missing:
        raise InputError(
            "pose_missing",
            f"{len(missing)} of {len(dataset)} images have no pose: {few_names(missing, 5)}.",
            where=dataset.root.name,
            hint="Give their poses, or have them found: start=auto.",
        )


def _without_features(given: _Given) -> InitialPoses:
    if given.posed.any():
        return given.without_matches()
    if (measured := _by_gimbal(given)) is not None:
        return measured
    name: PoseSource = "forward-facing"
    count = len(given.dataset)
    return InitialPoses(shown_from_cam(given.dataset.frames), name, (name,) * count)


def _by_gimbal(given: _Given) -> InitialPoses | None:
    """Poses by GPS and a gimbal, if these cover enough of the cameras."""
    if given.measured(given.poses.copy(), given.posed).sum() < _least_placed(given.dataset):
        return None
    return given.candidate("gimbal", None, "gimbal", np.zeros((len(given.poses),) * 2, dtype=np.int64))


def _least_placed(dataset: Dataset) -> int:
    return max(MIN_IMAGES, int(np.ceil(LEAST_REGISTERED * len(dataset))))


def _without_colmap(given: _Given, start: StartPoses) -> Seeding:
    if start == "colmap" or not given.posed.any():
        raise InputError(
            "colmap_missing",
            "finding poses needs COLMAP, which is not installed.",
            where=given.dataset.root.name,
            hint="Run `pip install 'biresnerf[colmap]'`, or give poses; photos that all look the same way can do "
            "without: start=none.",
        )
    warning = "COLMAP is not installed: the given poses were not compared with feature matches."
    noted = replace(given.dataset, warnings=(*given.dataset.warnings, warning))
    return _seeding(noted, given.without_matches())


def _beside_given(given: _Given, mapping: Mapping) -> Seeding:
    """The given poses, completed by the best model, and every model that places enough of the images."""
    carried: list[tuple[MatchedPoses, MappedModel]] = []
    for model in mapping.models:
        matched = carry_model(model, given.poses, given.posed)
        if matched is not None and model_lens_problem(given.dataset, model) is None:
            carried.append((matched, model))
    dataset = with_found_lenses(given.dataset, [model for _, model in carried])
    given = replace(given, dataset=dataset)
    best = carried[0][0] if carried else None
    completing = (
        None
        if best is None or given.posed.all()
        else MatchedPoses(
            best.mapper,
            np.where(given.posed[:, None, None], given.poses, best.world_from_cam),
            best.placed & ~given.posed,
        )
    )
    source = "given" if best is None else MATCHED[best.mapper]
    candidates = [given.candidate("given", completing, source, mapping.matches)]
    most = max(MIN_IMAGES, LEAST_PLACED * len(dataset))
    enough = [(matched, model) for matched, model in carried if matched.placed.sum() >= most]
    for matched, model in enough:
        if matched is best or adds_to(carried[0][1], model):
            name = MATCHED[matched.mapper]
            candidates.append(given.candidate(name, matched, name, mapping.matches))
    return _seeding(dataset, *candidates)


def _from_scratch(given: _Given, mapping: Mapping, start: StartPoses) -> Seeding:
    """The best model, and another one that sees through the same lenses; in the frame of the given poses, if any."""
    dataset = given.dataset
    models = [m for m in mapping.models if model_lens_problem(dataset, m) is None]
    placed = max((len(model.rows) for model in models), default=0)
    least = _least_placed(dataset)
    if placed < least:
        what = f"COLMAP could place {placed} of {len(dataset)} images; at least {least} are needed"
        if start == "colmap":
            raise InputError("seed_failed", f"{what}.", where=dataset.root.name, hint=OVERLAP_HINT)
        return _facing_forward(given, what)
    best = models[0]
    dataset = with_found_lenses(dataset, [best])
    candidates = []
    for model in models:
        if model is not best and (
            len(model.rows) < LEAST_PLACED * len(best.rows) or not adds_to(best, model)
        ):
            continue
        matched = _tied(model, replace(given, dataset=dataset))
        unplaced = replace(given, dataset=dataset, posed=given.posed & ~matched.placed)
        name: PoseSource = "colmap" if model is best else MATCHED[model.mapper]
        candidates.append(unplaced.candidate(name, matched, "colmap", mapping.matches))
    return _seeding(dataset, *candidates)


def _tied(model: MappedModel, given: _Given) -> MatchedPoses:
    """The model in the frame of given poses, whatever it contradicts; else of measured positions, or in its own."""
    carried = carry_model(model, given.poses, given.posed, judged=False)
    if carried is not None:
        return carried
    poses, placed = given.poses.copy(), np.zeros(len(given.poses), dtype=np.bool_)
    poses[model.rows], placed[model.rows] = model.world_from_cam, True
    return in_measured_frame(MatchedPoses(model.mapper, poses, placed), given.dataset)


def _facing_forward(given: _Given, what: str) -> Seeding:
    """Poses by a gimbal; else all cameras at one place, if photos are alike enough to have been taken from there."""
    dataset = given.dataset
    if (measured := _by_gimbal(given)) is not None:
        notes = (*dataset.warnings, f"{what}: {BY_GIMBAL}", *turning_notes(dataset))
        return _seeding(replace(dataset, warnings=notes), measured)
    alike, turns = 1 - typical_distance(unlikeness(dataset), len(dataset)), turning_notes(dataset)
    if alike < FACING_ALIKE:
        raise InputError(
            "insufficient_overlap",
            f"{what}, and the photos are too different to have been taken from nearly one place.",
            where=dataset.root.name,
            hint=" ".join((OVERLAP_HINT, *turns)),
        )
    warning = f"{what}: all cameras begin at one place, looking the same way, and find their poses without features."
    noted = replace(dataset, warnings=(*dataset.warnings, warning, *turns))
    return _seeding(noted, _without_features(given))


def _as_rigs(candidate: InitialPoses, cut: Cut) -> InitialPoses:
    """All views of a panorama at its place, as its first view has it: guesses are made of each view by itself."""
    poses = cut.poses_of_views((candidate.world_from_cam @ cut.cam_from_whole)[cut.firsts])
    sources = tuple(candidate.sources[cut.firsts[row]] for row in cut.rows)
    return replace(candidate, world_from_cam=poses, sources=sources)


def _seeding(dataset: Dataset, *candidates: InitialPoses) -> Seeding:
    if dataset.cut is not None:
        candidates = tuple(_as_rigs(candidate, dataset.cut) for candidate in candidates)
    first = candidates[0]
    frames = tuple(
        replace(frame, world_from_cam=pose, pose_source=source) if frame.world_from_cam is None else frame
        for frame, pose, source in zip(dataset.frames, first.world_from_cam, first.sources, strict=True)
    )
    guessed = [f"{f.name} ({f.pose_source})" for f in frames if f.pose_source in GUESSES]
    notes = dataset.warnings
    measured = [f.name for f in frames if f.pose_source == "gimbal"]
    if measured and first.source != "gimbal":
        notes += (
            f"No feature matches placed {len(measured)} of {len(frames)} images; their poses are those of GPS and the "
            f"drone's gimbal: {few_names(measured, 20)}",
        )
    if guessed:
        notes += (
            f"No feature matches placed {len(guessed)} of {len(frames)} images; their poses were guessed from "
            f"other images: {few_names(guessed, 20)}",
        )
    return Seeding(replace(dataset, frames=frames, warnings=notes), candidates)

"""How much work a run has to do, in the units of its forecast: from counts and sizes alone, without torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.panoramas.cut_panoramas import as_views
from biresnerf.data.scene_kind import SceneKind
from biresnerf.data.seeding.colmap_tracks import most_observations
from biresnerf.data.seeding.map_images import (
    ALL_PAIRS_UP_TO,
    BY_LIKENESS,
    BY_NAME,
    GUIDED_ALL_PAIRS_UP_TO,
    NEIGHBOURS,
    chosen_pairs,
    is_mapped,
    pair_count,
    thoroughness,
)
from biresnerf.data.seeding.match_poses import can_match
from biresnerf.forecast.run_forecast import Phase
from biresnerf.options.presets import FEWEST_OF_STAGE
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions, SeedingEffort

# Shares of all steps: where cameras are adjusted first, and how long the field then learns at their poses. The first is
# soon enough: on the dome scene cameras adjusted after half of the steps end as exact as after all (docs/estimator.md).
FIRST_ROUND, LEARNING = 0.5, 0.25
# Shares of the steps, and then of stage 1's, where matches placed most cameras: the field moves them no more, and has
# only to form for the choice of poses and for pictures (docs/speed.md).
MATCHED, MATCHED_COARSE = 0.5, 2 / 3
LEAST_ADJUSTED = 3  # cameras; memory alone bounds how many (`memory_needed`)
# Shares of a training after which fields are compared. What differs clearly differs more and more (docs/verdict.md).
LOOKS = (0.25, 0.5, 1.0)
TRIAL_STEPS = 200  # of those that choose the start
# Steps of both fields before people see their renders, but no more than so many times the trial's: earlier, shapes have
# no colours yet (lego at 100 px, true poses: 16.2 dB after 50 steps, 19.2 after 200, 19.7 after 300, for 1.8 times the
# work after the first look; fox 20.5 and 21.1, fountain-P11 23.6 and 23.8).
PICTURE_STEPS, PICTURE_SHARE = 200, 1.5
# Times the verdict's steps, to choose between photos and matches: shorter trials cannot detect wrong poses that agree
# with each other from bent ones (docs/estimator.md).
PHOTO_TRIALS = 2
# Thousands of observations of tracks that take as long as what an adjustment does without any: surfaces, patches, and
# their choice, which are bounded. lego at 100 px, fountain-P11, temple and fox (4, 35, 58 and 87 thousand) take 7.0,
# 6.9, 10.6 to 16.6, and 11.0 to 12.1 s.
ADJUSTMENT = 140.0
# The same of each of 1,000 cameras, and more of each of more, as the fronts of a flight grow: three adjustments and
# five covariances, of 20 and 2 s (`benchmarks.large.many_cameras`), less what their observations take.
EACH_ADJUSTED = 0.8
OBSERVED = 0.5  # of a photo's features, of tracks: 0.4 to 0.8 in these sets
# Trial steps that take as long as the rest of a verdict: fox's took 3.5 s without its training, 2.2 of them renders
# that take a third of it at coarser intervals.
JUDGING = 150.0
# Features of a megapixel, and the time for a small photo's.
FEATURES_OF_MEGAPIXEL, THOROUGH = 10_000, 4.0
# Thousands of features that an image takes as long to be mapped as: lego at 100 px (100 images of 100), temple (47 of
# 3,072) and fox (50 of 3,257) take 1.8, 8.9 and 9.1 s.
EACH_MAPPED = 0.25
SAMPLES = 1 << 15  # of a step of weight 1, with 8 levels in stage 2


@dataclass(frozen=True)
class Workload:
    """All of a run.

    Attributes:
        amounts: work in each phase, in its unit.
        step_weights: units of work in a step of either stage.
        share: the share of the requested steps that will be taken.
    """

    amounts: Mapping[Phase, float]
    step_weights: Mapping[Phase, float]
    share: float


def workload(
    dataset: Dataset, asked: RefineOptions, options: ResolvedOptions, *, kind: SceneKind, adjusts: bool
) -> Workload:
    """All work of a run, as far as known before its features are.

    Args:
        asked: options as the user gave them.
        options: the same with every value filled in.
        kind: of the scene.
        adjusts: whether all cameras are adjusted at the end.
    """
    dataset = as_views(dataset)
    matched = options.start in ("auto", "colmap") and can_match()
    mapped = matched and (options.start == "colmap" or is_mapped(dataset))
    if mapped and adjusts:
        options = matched_lengths(asked, options)
    weights = step_weights(options, kind=kind)
    share = steps_share(matched=matched and adjusts)
    coarse = options.coarse_steps_max
    amounts: dict[Phase, float] = {
        "coarse": coarse * weights["coarse"],
        "fine": (round(share * options.steps) - coarse) * weights["fine"],
    }
    observations = 0.0
    if matched:
        features, pairs, search = _search(dataset, options.seeding_effort)
        amounts["features"] = search
        amounts |= matching_work([features] * len(dataset), pairs)
        amounts["mapping"] *= mapped
        observations = min(OBSERVED * features * len(dataset), most_observations(len(dataset)))
    if mapped and options.start == "auto" and dataset.posed.any():
        amounts["trying"] = LOOKS[0] * _trial(TRIAL_STEPS, kind=kind)
    # Mostly, matches start the run, the first adjustment moves cameras little, and photos need not judge that.
    adjusting = adjusts * (1 if matched else 2) * adjustment_work(len(dataset), observations)
    amounts |= after_steps(options, kind, adjusting=adjusting, checks=False)
    return Workload(amounts, weights, share)


def adjustment_work(cameras: int, observations: float) -> float:
    """Work of one adjustment of all cameras."""
    return ADJUSTMENT + observations / 1000 + EACH_ADJUSTED * cameras * (cameras / 1000) ** 0.5


def can_be_adjusted(count: int) -> bool:
    """Whether so many cameras can be adjusted all at once."""
    return count >= LEAST_ADJUSTED


def step_weights(options: ResolvedOptions, *, kind: SceneKind) -> dict[Phase, float]:
    """Work of a step in either stage."""
    weight = options.samples_per_step / SAMPLES * kind.step_work
    return {"coarse": weight, "fine": weight * (0.5 + options.reconstruction_levels / 16)}


def steps_share(*, matched: bool) -> float:
    """The share of the requested steps that will be taken: fewer if matches move cameras, which then stand still."""
    return FIRST_ROUND + LEARNING if matched else 1.0


def matched_lengths(asked: RefineOptions, options: ResolvedOptions) -> ResolvedOptions:
    """The shorter lengths of a run whose cameras matches placed, except those that the user `asked` for."""
    coarse = [name for name in ("coarse_steps_min", "coarse_steps_max") if getattr(asked, name) is None]
    if asked.steps is None and len(coarse) == 2:
        options = options.with_steps(round(MATCHED * options.steps))
    shorter = {name: max(FEWEST_OF_STAGE, round(MATCHED_COARSE * getattr(options, name))) for name in coarse}
    if "coarse_steps_max" in shorter:
        least = shorter.get("coarse_steps_min", options.coarse_steps_min)
        shorter["coarse_steps_max"] = max(least, shorter["coarse_steps_max"])
    return options.model_copy(update=shorter)


def after_steps(
    options: ResolvedOptions, kind: SceneKind, *, adjusting: float, checks: bool
) -> dict[Phase, float]:
    """Work in the phases after the steps."""
    trial = _trial(options.trial_steps, kind=kind)
    pictured = picture_share(options.trial_steps, kind=kind)
    return {
        "adjusting": adjusting,
        "checking": photo_check(options, kind=kind) if checks else 0.0,
        "evaluating": kind.evaluation_work,
        # the first look of the first round decides mostly, and its fields are trained on for their pictures
        "judging": options.verdict * (JUDGING + pictured * trial),
    }


def photo_check(options: ResolvedOptions, *, kind: SceneKind) -> float:
    """Work of the trainings by which photos judge adjusted cameras."""
    return PHOTO_TRIALS * _trial(options.trial_steps, kind=kind)


def _search(dataset: Dataset, effort: SeedingEffort) -> tuple[float, float, float]:
    """Features of an image that COLMAP may find, the pairs it matches, and the work of its search for features."""
    count, guided = len(dataset), dataset.posed.all()
    all_up_to = GUIDED_ALL_PAIRS_UP_TO if guided else ALL_PAIRS_UP_TO
    chosen = chosen_pairs(count, NEIGHBOURS if guided else BY_NAME + BY_LIKENESS)
    pairs = pair_count(dataset, None) if count <= all_up_to else chosen
    asked = thoroughness(dataset, effort, pairs)
    if asked["likeliest"] is not None:
        pairs = min(pairs, chosen_pairs(count, asked["likeliest"]))
    sizes = [dataset.camera_of(i) for i in range(count)]
    shrunk = [min(1.0, asked["widest_image"] / max(camera.width, camera.height)) for camera in sizes]
    pixels = sum(c.width * c.height * share**2 for c, share in zip(sizes, shrunk, strict=True)) / 1e6
    features = min(asked["most_features"], FEATURES_OF_MEGAPIXEL * pixels / count)
    return features, pairs, pixels * (THOROUGH if asked["thorough"] else 1.0)


def matching_work(features: Sequence[float], pairs: float) -> dict[Phase, float]:
    """COLMAP's work where so many pairs of images with so many features [n] are to be matched."""
    mean = sum(features) / len(features)
    # Linear, as measured: of temple, fountain-P11 and fox (310, 55 and 330 pairs; 1,934, 6,688 and 3,257 features) a
    # million takes 12.4, 13.0 and 17.2 s.
    return {
        "matching": pairs * mean / 1e6,
        "mapping": EACH_MAPPED * len(features) + sum(features) / 1000,
    }


def picture_share(trial_steps: int, *, kind: SceneKind) -> float:
    """How much of a training it takes to show what a field has learned; 1 is the whole."""
    steps = trial_steps * kind.trial_steps
    return max(LOOKS[0], min(PICTURE_STEPS / max(steps, 1), PICTURE_SHARE))


def _trial(steps: int, *, kind: SceneKind) -> float:
    """Work of two trainings of so many steps."""
    return 2 * steps * kind.trial_steps * kind.step_work

"""How much work a run has before it, in the units of its forecast."""

from __future__ import annotations

from dataclasses import replace

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import load_images
from biresnerf.data.seeding.map_images import (
    ALL_PAIRS_UP_TO,
    BY_LIKENESS,
    BY_NAME,
    GUIDED_ALL_PAIRS_UP_TO,
    NEIGHBOURS,
    chosen_pairs,
    pair_count,
    thoroughness,
)
from biresnerf.data.seeding.match_poses import can_match
from biresnerf.forecast import Forecast, Phase
from biresnerf.options.refine_options import ResolvedOptions, SeedingEffort
from biresnerf.refinement.finish.photo_trial import TIMES
from biresnerf.refinement.optimise.methods import find_method
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.two_stages import TwoStages
from biresnerf.refinement.start.choose_start import TRIAL_STEPS
from biresnerf.refinement.start.first_step import adjusts_cameras
from biresnerf.refinement.views.pose_trials import LOOKS, OPEN_STEP, OPEN_STEPS

# Shares of all steps: where cameras are adjusted first, and how long the field then learns at their poses. The first is
# soon enough: on the demo scene cameras adjusted after half of the steps end as exact as after all (docs/estimator.md).
FIRST_ROUND, LEARNING = 0.5, 0.25
# As measured (docs/speed.md): the rendering of a scene with a background against one without; an adjustment's
# work in thousands of observations of tracks, how many a photo has, and the work without any.
OPEN_EVALUATION, OBSERVATIONS, ADJUSTMENT = 3.0, 1200, 20.0
# Features of a megapixel, and the time for a small photo's.
FEATURES_OF_MEGAPIXEL, THOROUGH = 10_000, 4.0
PHOTOS_LOOKED_AT, SMALL = 3, 64  # to see whether there is a background, and px
SAMPLES = 1 << 15  # of a step of weight 1, with 8 levels in stage 2


def expect_run(forecast: Forecast, dataset: Dataset, options: ResolvedOptions) -> None:
    """All of a run, as far as it is known before its features are."""
    few = replace(dataset, frames=dataset.frames[:PHOTOS_LOOKED_AT])
    unbounded = load_images(few, SMALL, options.background).background is None
    adjusts = adjusts_cameras(dataset, find_method(options.method))
    matched = options.start in ("auto", "colmap") and can_match()
    forecast.step_weights = step_weights(options, unbounded=unbounded)
    forecast.share = _share(matched=matched and adjusts)
    coarse = options.coarse_steps_max
    forecast.plan_steps(coarse, round(forecast.share * options.steps) - coarse)
    if matched:
        forecast.left |= _matching(dataset, options.seeding_effort)
    if matched and options.start == "auto" and dataset.posed.any():
        forecast.left["trying"] = LOOKS[0] * _trial(TRIAL_STEPS, unbounded=unbounded)
    each = ADJUSTMENT + matched * OBSERVATIONS * len(dataset) / 1000 if adjusts else 0.0
    forecast.left |= _after_steps(options, unbounded, adjusting=2 * each, checks=matched and adjusts)


def expect_rest(stages: TwoStages) -> None:
    """All of a run from where its steps begin or go on."""
    forecast, optimiser = stages.forecast, stages.optimiser
    forecast.leave()
    forecast.continues(sum(stages.record.seconds.values()))
    forecast.step_weights = step_weights(optimiser.options, unbounded=optimiser.frame.unbounded)
    matched = stages.scene.tracks is not None
    forecast.share = _share(matched=matched and adjusts_cameras(stages.scene.dataset, optimiser.method))
    forecast.left = work_ahead(stages)


def work_ahead(stages: TwoStages, options: ResolvedOptions | None = None) -> dict[Phase, float]:
    """What is left of a run after its first step, with other options (of its steps) if given."""
    scene, optimiser = stages.scene, stages.optimiser
    unbounded = optimiser.frame.unbounded
    steps = optimiser.schedule.steps if options is None else options.steps
    options = options or optimiser.options
    coarse, fine = stages.steps_left(steps, options.coarse_steps_max)
    weights = step_weights(options, unbounded=unbounded)
    adjusts, first = adjusts_cameras(scene.dataset, optimiser.method), not stages.record.adjusted
    each = adjustment(scene) if adjusts else 0.0
    checks = adjusts and first and scene.tracks is not None
    return {
        "coarse": coarse * weights["coarse"],
        "fine": fine * weights["fine"],
        **_after_steps(options, unbounded, adjusting=(1 + first) * each, checks=checks),
    }


def adjustment(scene: Scene) -> float:
    """Work of one adjustment of all cameras."""
    return ADJUSTMENT + (0.0 if scene.tracks is None else len(scene.tracks.point) / 1000)


def step_weights(options: ResolvedOptions, *, unbounded: bool) -> dict[Phase, float]:
    """Work of a step in either stage."""
    weight = options.samples_per_step / SAMPLES * (OPEN_STEP if unbounded else 1.0)
    return {"coarse": weight, "fine": weight * (0.5 + options.reconstruction_levels / 16)}


def _matching(dataset: Dataset, effort: SeedingEffort) -> dict[Phase, float]:
    """What COLMAP has before it, as far as it is known before its features are."""
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
    return {
        "features": pixels * (THOROUGH if asked["thorough"] else 1.0),
        "matching": pairs * features**2 / 1e9,
        "mapping": count,
    }


def _share(*, matched: bool) -> float:
    """Of the steps asked for, how many will be taken: mostly, matches move the cameras, which then stand still."""
    return FIRST_ROUND + LEARNING if matched else 1.0


def _after_steps(
    options: ResolvedOptions, unbounded: bool, *, adjusting: float, checks: bool
) -> dict[Phase, float]:
    trial = _trial(options.trial_steps, unbounded=unbounded)
    return {
        "adjusting": adjusting,
        "checking": TIMES * trial if checks else 0.0,
        "evaluating": OPEN_EVALUATION if unbounded else 1.0,
        "judging": LOOKS[0] * trial
        if options.verdict
        else 0.0,  # the first look of the first round decides mostly
    }


def _trial(steps: int, *, unbounded: bool) -> float:
    """Work of two trainings of so many steps."""
    return 2 * steps * (OPEN_STEPS * OPEN_STEP if unbounded else 1.0)

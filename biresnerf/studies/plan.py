"""What a comparison runs: variants of the options on scenes, starts and seeds, optionally at equal time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from biresnerf.options.presets import SCALED_BY_STEPS
from biresnerf.options.refine_options import RefineOptions, parse_options
from biresnerf.studies.cell import Cell, CellResult, EqualTime, Perturbation, Scene
from biresnerf.studies.run_cells import finished, run_in_child

# At equal time a variant's speed is measured by a probe, then by a run of about this share of the time.
PROBE_STEPS, CALIBRATION_SHARE = 20, 0.1
OF_METHOD = "method."  # before the names of its fields, among settings


def options_of(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that are options of a refinement."""
    return {key: value for key, value in settings.items() if not key.startswith(OF_METHOD)}


@dataclass(frozen=True)
class Variant:
    """A named set of options; `settings` override those that all variants share.

    ``method.FIELD`` among them is a field of the method, e.g. ``{"method.repair": False}``.
    """

    name: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """A whole comparison. All other variants are compared with the first.

    Attributes:
        settings: options of all variants.
        equal_time: give the other variants the first one's optimisation time instead of their own steps.
    """

    scenes: tuple[Scene, ...]
    starts: tuple[Perturbation, ...]
    variants: tuple[Variant, ...]
    settings: dict[str, Any]
    equal_time: bool = False

    def options(self, variant: Variant, scene: Scene, start: Perturbation) -> RefineOptions:
        """The variant's options.

        By default the run's seed is that of the noise. It starts from the perturbed poses without feature matches,
        renders no orbit, returns the refined poses without a verdict, and holds out no views of a scene that has test
        views. Raises `InputError` for options and for changes of the method.
        """
        defaults: dict[str, Any] = {"seed": start.seed, "start": "given", "orbit_frames": 0, "verdict": False}
        if scene.test_file is not None:
            defaults["holdout"] = 0
        options = parse_options({**defaults, **options_of(self.settings), **options_of(variant.settings)})
        options.resolved("cpu")  # raises for invalid combinations before anything runs
        if changes := self.method_changes(variant):
            from biresnerf.refinement.optimise.method_changes import changed  # loads torch
            from biresnerf.refinement.optimise.methods import find_method

            changed(find_method(options.method), changes)
        return options

    def method_changes(self, variant: Variant) -> dict[str, Any]:
        """What of the variant's method differs from the one that its options name."""
        given = {**self.settings, **variant.settings}
        return {
            key.removeprefix(OF_METHOD): value for key, value in given.items() if key.startswith(OF_METHOD)
        }


@dataclass(frozen=True)
class Entry:
    """A cell's place in the comparison, and its result."""

    scene: str
    start: Perturbation
    variant: str
    result: CellResult


def with_steps(options: RefineOptions, steps: int) -> RefineOptions:
    """The same run in proportion, `steps` long. Raises `InputError` where options do not allow it."""
    own = options.resolved("cpu")
    ratio = steps / own.steps
    scaled = {key: max(10, round(getattr(own, key) * ratio)) for key in SCALED_BY_STEPS}
    scaled["coarse_steps_max"] = min(scaled["coarse_steps_max"], steps)
    scaled["coarse_steps_min"] = min(scaled["coarse_steps_min"], scaled["coarse_steps_max"])
    return parse_options({**options.model_dump(), **scaled, "steps": steps})


@dataclass(frozen=True)
class Runner:
    """Returns finished cells, and runs the others.

    Attributes:
        cells: the folder of all cells.
        say: called with a line about each cell that is run.
        retry_failed: whether a recorded failure is run again.
    """

    cells: Path
    say: Callable[[str], None]
    retry_failed: bool = False

    def __call__(self, cell: Cell, title: str) -> CellResult:
        known = finished(self.cells, cell)
        if known is not None and not (self.retry_failed and known.error):
            return known
        self.say(f"{title} …")
        result = run_in_child(self.cells, cell)
        self.say(f"{title}: {_in_short(result)}")
        return result


def run_plan(plan: Plan, run: Callable[[Cell, str], CellResult]) -> list[Entry]:
    """Every cell of the plan, in the order scene, start, variant."""
    entries = []
    for scene, start in product(plan.scenes, plan.starts):
        first: CellResult | None = None
        for variant in plan.variants:
            title = f"{scene.name}, {start.label}, seed {start.seed}: {variant.name}"
            cell = Cell(
                scene=scene,
                start=start,
                options=plan.options(variant, scene, start),
                method=plan.method_changes(variant),
            )
            if plan.equal_time and first is not None:
                result = _run_in_same_time(cell, first, run, title)
            else:
                result = run(cell, title)
            first = first or result
            entries.append(Entry(scene.name, start, variant.name, result))
    return entries


def _run_in_same_time(
    cell: Cell, first: CellResult, run: Callable[[Cell, str], CellResult], title: str
) -> CellResult:
    """The cell with as many steps as fit into the first variant's time, estimated by short runs of its own."""
    if first.outcome is None:
        return CellResult(cell=cell, error="the first variant failed, so there is no time to equal")
    seconds = first.outcome.optimisation_s
    steps, ms_per_step = PROBE_STEPS, 0.0
    while True:
        untested = cell.scene.model_copy(update={"test_file": None, "test_views": 0})
        short = cell.model_copy(update={"scene": untested, "options": with_steps(cell.options, steps)})
        calibration = run(short, f"{title}, {steps} steps to measure its speed")
        if calibration.outcome is None:
            return CellResult(cell=cell, error=f"calibration failed: {calibration.error}")
        ms_per_step = 1000 * calibration.outcome.optimisation_s / steps
        # The probe shows how many steps fit into a measurement that takes a tenth of the time.
        longer = round(CALIBRATION_SHARE * 1000 * seconds / ms_per_step)
        if steps > PROBE_STEPS or longer < 2 * PROBE_STEPS:
            break
        steps = longer
    fitting = max(PROBE_STEPS, round(1000 * seconds / ms_per_step / 10) * 10)
    equal = EqualTime(seconds=seconds, calibration_steps=steps, calibration_ms_per_step=round(ms_per_step, 3))
    whole = cell.model_copy(update={"options": with_steps(cell.options, fitting), "equal_time": equal})
    return run(whole, f"{title}, {fitting} steps")


def _in_short(result: CellResult) -> str:
    if result.outcome is None:
        return f"FAILED: {(result.error or '').splitlines()[-1]}"
    outcome = result.outcome
    rotation = outcome.after.aligned.rotation_deg
    views = f", {outcome.views.psnr:.2f} dB" if outcome.views else ""
    return f"rotation {rotation.mean:.3g}° (most {rotation.max:.3g}°){views}, {outcome.optimisation_s:.0f} s"

"""The tables of a comparison as data: per scene, over all scenes, and the tests between variants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from biresnerf.frozen_model import FrozenModel
from biresnerf.studies.cell import Outcome
from biresnerf.studies.plan import Entry


@dataclass(frozen=True)
class Metric:
    """One column. ``of`` returns None where a run has no such value; ``over_seeds`` combines several seeds."""

    key: str
    title: str
    digits: int
    of: Callable[[Outcome], float | None]
    over_seeds: Callable[[Sequence[float]], float] = lambda values: float(np.mean(values))
    tested: bool = False


# Rotation and translation as BARF and BAA-NGP define them, after BARF's alignment.
METRICS = (
    Metric("start_deg", "start °", 2, lambda o: o.before.aligned.rotation_deg.mean),
    Metric(
        "matched_deg", "COLMAP °", 3, lambda o: o.matched.aligned.rotation_deg.mean if o.matched else None
    ),
    Metric("matched_cameras", "COLMAP placed", 1, lambda o: float(o.matched.cameras) if o.matched else None),
    Metric("rotation_deg", "rotation °", 3, lambda o: o.after.aligned.rotation_deg.mean, tested=True),
    Metric("rotation_median_deg", "median", 3, lambda o: o.after.aligned.rotation_deg.median),
    Metric("rotation_max_deg", "max", 2, lambda o: o.after.aligned.rotation_deg.max, max),
    Metric("not_found", "over 1°", 1, lambda o: float(o.not_found)),
    Metric("translation", "t ×100", 3, lambda o: o.after.aligned.translation_table.mean, tested=True),
    Metric("centre_percent", "centre %", 3, lambda o: o.after.aligned.centre_percent.mean),
    Metric("psnr", "PSNR", 2, lambda o: o.views.psnr if o.views else None, tested=True),
    Metric("ssim", "SSIM", 4, lambda o: o.views.ssim if o.views else None, tested=True),
    Metric(
        "unshared_opacity",
        "unshared",
        4,
        lambda o: o.views.unshared_opacity if o.views else None,
        tested=True,
    ),
    Metric("depth_error", "depth off", 4, lambda o: o.views.depth_error if o.views else None, tested=True),
    Metric("lpips", "LPIPS", 4, lambda o: o.views.lpips if o.views else None, tested=True),
    Metric("preparing_s", "before s", 1, lambda o: o.seconds["preparing"]),
    Metric("coarse_s", "stage 1 s", 1, lambda o: o.seconds["coarse"]),
    Metric("fine_s", "stage 2 s", 1, lambda o: o.seconds["fine"]),
    Metric("optimisation_s", "both s", 1, lambda o: o.optimisation_s, tested=True),
    Metric("total_s", "all s", 1, lambda o: o.run_s),
    Metric("peak_mb", "memory MB", 0, lambda o: o.peak_memory_bytes / 2**20, max),
    Metric("steps", "steps", 0, lambda o: float(o.options.steps)),
    # A method of one stage has no switch.
    Metric("switch_step", "switch", 0, lambda o: float(o.switch_step or 0) if o.switch_reason else None),
)


class Row(FrozenModel):
    """One variant on one scene from one kind of start, over the seeds: means; for max and memory the largest."""

    scene: str
    start: str
    variant: str
    seeds: tuple[int, ...] = Field(description="Of the completed runs.")
    failed: int
    values: dict[str, float | None]


class Summary(FrozenModel):
    """One variant from one kind of start over the scenes: mean and median of the rows."""

    start: str
    variant: str
    scenes: int
    mean: dict[str, float | None]
    median: dict[str, float | None]


class PairedTest(FrozenModel):
    """A two-sided Wilcoxon signed-rank test of ``other - first``."""

    pairs: int = Field(description="n: scenes x starts x seeds that both variants finished.")
    differing: int = Field(description="Pairs that differ; the test ignores the others.")
    statistic: float | None = Field(
        description="The smaller of the two rank sums; None without a difference."
    )
    p_value: float | None
    median_difference: float = Field(description="Median of other - first.")


class Difference(FrozenModel):
    """The test of one metric between the first variant and another, over all scenes, starts and seeds."""

    metric: str
    first: str
    other: str
    test: PairedTest


class Failure(FrozenModel):
    """A run that ended with an error."""

    scene: str
    start: str
    seed: int
    variant: str
    error: str


class Tables(FrozenModel):
    """``tables.json``."""

    variants: dict[str, dict[str, object]] = Field(description="Settings of each, over the shared ones.")
    settings: dict[str, object] = Field(description="Settings that all variants share.")
    machine: str
    rows: tuple[Row, ...]
    summaries: tuple[Summary, ...]
    differences: tuple[Difference, ...]
    failures: tuple[Failure, ...]
    notes: tuple[str, ...]


def rows_of(entries: Sequence[Entry]) -> tuple[Row, ...]:
    """A row for every scene, kind of start and variant, in the order of the entries."""
    grouped: dict[tuple[str, str, str], list[Entry]] = {}
    for entry in entries:
        grouped.setdefault((entry.scene, entry.start.label, entry.variant), []).append(entry)
    rows = []
    for (scene, start, variant), group in grouped.items():
        outcomes = [entry.result.outcome for entry in group if entry.result.outcome is not None]
        rows.append(
            Row(
                scene=scene,
                start=start,
                variant=variant,
                seeds=tuple(entry.start.seed for entry in group if entry.result.outcome is not None),
                failed=len(group) - len(outcomes),
                values={metric.key: _over_seeds(metric, outcomes) for metric in METRICS},
            )
        )
    return tuple(rows)


def _over_seeds(metric: Metric, outcomes: Sequence[Outcome]) -> float | None:
    values = [value for value in map(metric.of, outcomes) if value is not None]
    return metric.over_seeds(values) if values else None


def summaries_of(rows: Sequence[Row]) -> tuple[Summary, ...]:
    """Mean and median over the scenes, for every kind of start and variant."""
    grouped: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.seeds:
            grouped.setdefault((row.start, row.variant), []).append(row)
    summaries = []
    for (start, variant), group in grouped.items():
        columns = {
            metric.key: [v for row in group if (v := row.values[metric.key]) is not None]
            for metric in METRICS
        }
        mean = {key: float(np.mean(values)) if values else None for key, values in columns.items()}
        median = {key: float(np.median(values)) if values else None for key, values in columns.items()}
        summaries.append(Summary(start=start, variant=variant, scenes=len(group), mean=mean, median=median))
    return tuple(summaries)


def differences_of(entries: Sequence[Entry]) -> tuple[Difference, ...]:
    """Wilcoxon's test of every other variant against the first, for each tested metric."""
    variants = list(dict.fromkeys(entry.variant for entry in entries))
    outcomes = {
        (entry.scene, entry.start, entry.variant): entry.result.outcome
        for entry in entries
        if entry.result.outcome is not None
    }
    differences = []
    for other in variants[1:]:
        pairs = [
            (outcome, outcomes[scene, start, other])
            for (scene, start, variant), outcome in outcomes.items()
            if variant == variants[0] and (scene, start, other) in outcomes
        ]
        for metric in (metric for metric in METRICS if metric.tested):
            both = [(metric.of(a), metric.of(b)) for a, b in pairs]
            known = [(a, b) for a, b in both if a is not None and b is not None]
            test = paired_wilcoxon([a for a, _ in known], [b for _, b in known])
            if test is not None:
                differences.append(Difference(metric=metric.key, first=variants[0], other=other, test=test))
    return tuple(differences)


def paired_wilcoxon(first: Sequence[float], other: Sequence[float]) -> PairedTest | None:
    """Test pairs of results of two variants, in the same order; None if there are none.

    The test is exact for up to 50 differing pairs without ties, as scipy decides.
    """
    from scipy.stats import wilcoxon

    difference = np.asarray(other, dtype=np.float64) - np.asarray(first, dtype=np.float64)
    if not len(difference):
        return None
    differing = int(np.count_nonzero(difference))
    statistic = p_value = None
    if differing:
        tested = wilcoxon(difference, zero_method="wilcox", alternative="two-sided")
        statistic, p_value = float(tested.statistic), float(tested.pvalue)
    return PairedTest(
        pairs=len(difference),
        differing=differing,
        statistic=statistic,
        p_value=p_value,
        median_difference=float(np.median(difference)),
    )


def notes_of(entry: Entry) -> Iterator[str]:
    """Notes on the tables: what was said, which views were scored, why LPIPS is absent, how equal time was reached."""
    outcome, equal = entry.result.outcome, entry.result.cell.equal_time
    run = f"{entry.scene}, {entry.start.label}, seed {entry.start.seed}, {entry.variant}"
    if outcome is not None and outcome.verdict is not None:
        yield f"{run}: {outcome.verdict}" + (f", poses {outcome.chosen}" if outcome.chosen else "")
    if outcome is not None and outcome.views is not None:
        yield f"{entry.scene}: PSNR and SSIM over {outcome.views.count} {outcome.views.kind} views"
        if outcome.views.lpips_absent:
            yield f"no LPIPS: {outcome.views.lpips_absent}"
    if equal is not None:
        took = f", took {outcome.optimisation_s:.1f} s" if outcome is not None else ""
        yield (
            f"{run}: {equal.seconds:.1f} s at {equal.calibration_ms_per_step:.1f} ms a step "
            f"(measured over {equal.calibration_steps} steps) gave {entry.result.cell.options.steps} steps{took}"
        )


def make_tables(
    entries: Sequence[Entry],
    variants: dict[str, dict[str, object]],
    settings: dict[str, object],
    machine: str,
) -> Tables:
    """All tables of a comparison."""
    rows = rows_of(entries)
    return Tables(
        variants=variants,
        settings=settings,
        machine=machine,
        rows=rows,
        summaries=summaries_of(rows),
        differences=differences_of(entries),
        failures=tuple(
            Failure(
                scene=e.scene, start=e.start.label, seed=e.start.seed, variant=e.variant, error=e.result.error
            )
            for e in entries
            if e.result.error is not None
        ),
        notes=tuple(dict.fromkeys(note for entry in entries for note in notes_of(entry))),
    )

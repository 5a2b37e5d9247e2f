"""Which of two results has the better poses: fixed rules, explained in docs/results.md."""

from __future__ import annotations

from typing import Any

from biresnerf.comparison.conclusion import ComparedFigure, Comparison, Outcome, Side
from biresnerf.comparison.measures import CONFIRMED, EXACT, FEWEST, Measures, Result, measures_of
from biresnerf.comparison.pose_differences import FAR_BOUNDS, PoseDifferences, pose_differences
from biresnerf.data.formats.simple.poses_json import PosesDocument
from biresnerf.options.refine_options import OPTIONS, RESULT_OPTIONS
from biresnerf.report import Report

MOSTLY = 0.5  # share of the photos; if more contradict each other, the results do
NAMED = 5  # photos in a sentence


def compare_results(first: tuple[Report, PosesDocument], second: tuple[Report, PosesDocument]) -> Comparison:
    """Which of two results is better, and by what; or why that cannot be known.

    Each is given as its report.json and its poses.json, the returned poses. Swapping the two swaps the outcome.
    """
    one, other = Result(*first), Result(*second)
    differences = pose_differences(one.poses, other.poses)
    measures = measures_of(one, other)
    contradict = len(differences.contradicting) > MOSTLY * len(differences.rows)
    outcome, conclusion = _conclude(measures, differences, contradict=contradict)
    comparable = len(differences.rows) >= FEWEST
    return Comparison(
        outcome=outcome,
        contradict=contradict and comparable,
        conclusion=conclusion + _verdicts(one, other, contradict=contradict and comparable),
        why=_grounds(measures, differences),
        photos=len(differences.rows),
        figures=tuple(f for f in (*measures.known, *_others(one, other)) if f.first != f.second),
        poses=tuple(sorted(differences.rows, key=lambda row: -row.turned_deg)),
    )


def _conclude(measures: Measures, found: PoseDifferences, *, contradict: bool) -> tuple[Outcome, str]:
    if len(found.rows) < FEWEST:
        held = {0: "no photo", 1: "only one photo"}.get(len(found.rows), f"only {len(found.rows)} photos")
        return "unknown", f"It cannot be known which result is better: they have {held} in common."
    if found.equal:
        return "same", "Both results hold the same poses."
    outcome, ground = _favoured(measures, contradict=contradict)
    if contradict:
        favour = {
            "first": f"The evidence favours the first: it is better by {ground}.",
            "second": f"The evidence favours the second: it is better by {ground}.",
        }.get(outcome, f"Which one cannot be known: {ground}.")
        return outcome, f"The results contradict each other: {_far(found)}. At most one is right. {favour}"
    some = f" But {_far(found)}: there, at most one is right." if found.contradicting else ""
    if outcome in ("first", "second"):
        return outcome, f"The {outcome} result is better by {ground}.{some}"
    if found.bounds is not None and found.bounds <= 1 and not _disagree(measures):
        return "same", (
            f"Neither result is better: their poses differ by less than their stated accuracy, and {ground}.{some}"
        )
    return "unknown", f"It cannot be known which result is better: {ground}.{some}"


def _favoured(measures: Measures, *, contradict: bool) -> tuple[Outcome, str]:
    """The better result and by what; or unknown and why. Where results contradict, what they state is in dispute."""
    for evidence in _by_weight(measures, contradict=contradict):
        sides = {figure.better for figure in evidence} & {"first", "second"}
        if len(sides) == 2:
            parts = [f"{_lower(f.name)} for the {f.better}" for f in evidence if f.better in sides]
            return "unknown", f"the evidence disagrees, {' and '.join(parts)}"
        for side in ("first", "second"):
            if side in sides:
                return side, " and ".join(_lower(f.name) for f in evidence if f.better == side)
    told = [figure for figure in measures.known if figure.better is not None]
    if not told:
        return "unknown", "they have no measure in common"
    return "unknown", "no measure tells them apart"


def _by_weight(measures: Measures, *, contradict: bool) -> list[list[ComparedFigure]]:
    """What was measured comes before what a result says of itself."""
    stated = [measures.confirmed] if contradict else [measures.confirmed, measures.exact]
    groups = ([measures.matches, measures.views], stated)
    return [[figure for figure in group if figure is not None] for group in groups]


def _disagree(measures: Measures) -> bool:
    sides: set[Side | None] = {figure.better for figure in measures.known}
    return {"first", "second"} <= sides


def _far(found: PoseDifferences) -> str:
    """How far the poses of the contradicting photos differ, in words."""
    far = found.contradicting
    turn = sorted(row.turned_deg for row in far)[len(far) // 2]
    which = f"{len(far)} of {len(found.rows)} photos"
    if len(far) <= NAMED and 2 * len(far) <= len(found.rows):
        which += f" ({', '.join(row.name for row in far)})"
    if found.stated_deg is not None and turn <= FAR_BOUNDS * found.stated_deg:  # by position alone
        return f"the positions of {which} differ by more than {FAR_BOUNDS:g} times what both state"
    stated = (
        f"far more than the ± {found.stated_deg:.2g}° that they state together"
        if found.stated_deg is not None
        else "and most have no stated accuracy"
    )
    return f"the poses of {which} differ by {turn:.2g}° typically, {stated}"


def _verdicts(first: Result, second: Result, *, contradict: bool) -> str:
    verdicts = [side.verdict.verdict if side.verdict else None for side in (first, second)]
    if not contradict or verdicts != ["improved", "improved"]:
        return ""
    return " Both were called improved, each against its own input; that does not hold for both."


def _grounds(measures: Measures, found: PoseDifferences) -> tuple[str, ...]:
    if found.equal or len(found.rows) < FEWEST:
        return ()
    telling = [f for f in measures.known if f.first != f.second]
    return (_distance(found), *map(_sentence, telling))


def _distance(found: PoseDifferences) -> str:
    most = max(row.turned_deg for row in found.rows)
    text = f"{len(found.rows)} photos in both: poses differ by {found.median_deg:.2g}° typically, {most:.2g}° at most"
    if found.bounds is None:
        return f"{text}; most have no stated accuracy."
    if found.bounds <= 1:
        return f"{text}; typically within the stated accuracy."
    return (
        f"{text}; typically {found.bounds:.2g} times the stated accuracy (far: above {FAR_BOUNDS:g} times)."
    )


def _sentence(figure: ComparedFigure) -> str:
    said = {
        "first": "the first is better",
        "second": "the second is better",
        "same": "no difference that matters",
        "open": "too uncertain to tell",
        None: "says nothing",
    }[figure.better]
    note = f", as {figure.note}" if figure.note else ""
    return f"{figure.name}: {figure.first} and {figure.second}; {said}{note}."


def _lower(name: str) -> str:
    return {CONFIRMED: "the number of photos confirmed", EXACT: "the stated accuracy"}.get(
        name, name[0].lower() + name[1:]
    )


def _others(first: Result, second: Result) -> list[ComparedFigure]:
    """Figures that say nothing about the poses by themselves: what was done, and with which options."""
    rows = [("Photos", *(str(len(side.report.images)) for side in (first, second)))]
    rows.append(("Steps", *(str(side.report.steps_done) for side in (first, second))))
    if first.report.heldout and second.report.heldout:
        renders = [f"{side.psnr:.2f} dB" for side in (first.report.heldout, second.report.heldout)]
        rows.append(("Final render, held-out views", *renders))
    rows.append(("Time", *(f"{sum(side.report.seconds.values()):.0f} s" for side in (first, second))))
    one, other = (side.report.options for side in (first, second))
    # Options in proportion to the steps differ only because of these.
    forth, back = one.with_steps(other.steps), other.with_steps(one.steps)
    for name in OPTIONS:
        a, b = getattr(one, name), getattr(other, name)
        follows = name != "steps" and (getattr(forth, name) == b or getattr(back, name) == a)
        if name in RESULT_OPTIONS and a != b and not follows:
            rows.append((f"Option “{OPTIONS[name].title}”", _value(a), _value(b)))
    return [ComparedFigure(name=name, first=a, second=b) for name, a, b in rows]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple | list):
        return ", ".join(map(str, value)) or "none"
    return "–" if value in (None, "") else str(value).replace("_", " ")

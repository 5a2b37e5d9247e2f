"""The measures that decide which of two results has the better poses.

Each measures the poses that a result returned, which may be the input's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from biresnerf.arrays import Array
from biresnerf.comparison.conclusion import ComparedFigure, Side
from biresnerf.data.formats.simple.poses_json import PosesDocument
from biresnerf.judging.compare import (
    FITS_BELOW,
    MATCH_ERRORS,
    PHOTOS_CONFIRMED,
    STATED_ACCURACY,
    UNSEEN_PSNR,
    compare,
    octaves,
)
from biresnerf.report import Finding, ImageReport, Report, Verdict

FEWEST = 3  # photos that a measure needs in both results
SIMILAR_MATCHES = 2.0  # sets of feature matches that differ by more than this factor are no common measure
LEAST_PX = 1e-3  # of a matching error, which may be zero on made scenes
LEAST_DEG = 1e-4  # of a stated accuracy
MATCHES, VIEWS = "Fit of feature matches", "Unseen views"
CONFIRMED, EXACT = "Photos confirmed", "Poses exact to"
NONE = "–"
_SIDES: Mapping[Finding, Side] = {"better": "first", "worse": "second", "same": "same", "open": "open"}


class Result(NamedTuple):
    """The parts of a result of `refine` that are compared."""

    report: Report
    poses: PosesDocument

    @property
    def verdict(self) -> Verdict | None:
        return self.report.verdict or self.report.verdict_so_far

    @property
    def kept_input(self) -> bool:
        return self.verdict is not None and self.verdict.returned == "input"

    def images(self) -> dict[str, ImageReport]:
        return {image.name: image for image in self.report.images}

    def long_sides(self) -> dict[str, int]:
        """The long side of each photo, px at full size."""
        cameras = self.poses.cameras
        return {i.name: max(cameras[i.camera].width, cameras[i.camera].height) for i in self.poses.images}


@dataclass(frozen=True)
class Measures:
    """All four. A measure is None where neither result has it; it favours neither where they share no data for it."""

    matches: ComparedFigure | None
    views: ComparedFigure | None
    confirmed: ComparedFigure | None
    exact: ComparedFigure | None

    @property
    def known(self) -> tuple[ComparedFigure, ...]:
        """The measures that exist, the weightiest first."""
        return tuple(m for m in (self.matches, self.views, self.confirmed, self.exact) if m is not None)


def measures_of(first: Result, second: Result) -> Measures:
    """The measures of the photos that both results hold."""
    one, other = first.images(), second.images()
    common = [name for name in one if name in other]
    pairs = [(one[name], other[name]) for name in common]
    return Measures(
        matches=_matches(first, second, pairs),
        views=_views(first, second, pairs),
        confirmed=_confirmed(pairs),
        exact=_exact(pairs),
    )


_Pairs = list[tuple[ImageReport, ImageReport]]


def _matches(first: Result, second: Result, pairs: _Pairs) -> ComparedFigure | None:
    sets = [side.verdict.epipolar if side.verdict else None for side in (first, second)]
    names, values = _both_known(pairs, _epipolar_px(first), _epipolar_px(second))
    texts = [_text(side, "px") for side in values] if len(names) else _medians(first, second, pairs)
    if sets[0] is None or sets[1] is None or len(names) < FEWEST:
        return _without(MATCHES, texts, "the results have no photos in common whose matches were measured")
    counts = sorted(evidence.matches for evidence in sets if evidence is not None)
    if counts[1] > SIMILAR_MATCHES * counts[0]:
        return _without(MATCHES, texts, f"the matches are different ones, {counts[0]} and {counts[1]}")
    sizes = [side.long_sides() for side in (first, second)]
    if any(sizes[0].get(name) != sizes[1].get(name) for name in names):
        return _without(MATCHES, texts, "the photos differ in size")
    side = _SIDES[compare(octaves(values[1], values[0], LEAST_PX), MATCH_ERRORS).finding]
    note = ""
    if side in ("first", "second"):
        index = 0 if side == "first" else 1
        result, evidence = (first, second)[index], sets[index]
        own = (evidence is not None and evidence.independent) or (result.kept_input and _given(result))
        shares = [values[index][n] / sizes[index][name] for n, name in enumerate(names)]
        if float(np.median(shares)) > FITS_BELOW:
            side, note = "open", "the matches fit neither result"
        elif not own:
            side, note = "open", f"the poses of the {side} result come from these matches"
    return ComparedFigure(name=MATCHES, first=texts[0], second=texts[1], better=side, note=note)


def _views(first: Result, second: Result, pairs: _Pairs) -> ComparedFigure | None:
    trials = [side.verdict.heldout if side.verdict else None for side in (first, second)]
    names, values = _both_known(pairs, _trial_psnr(first), _trial_psnr(second))
    texts = [
        NONE if trial is None else f"{trial.psnr.before if side.kept_input else trial.psnr.after:.2f} dB"
        for side, trial in zip((first, second), trials, strict=True)
    ]
    if trials[0] is None or trials[1] is None:
        return _without(VIEWS, texts, "only one result was tested on them")
    if trials[0].steps != trials[1].steps:
        return _without(VIEWS, texts, f"the tests trained for {trials[0].steps} and {trials[1].steps} steps")
    if first.report.working_size != second.report.working_size:
        return _without(VIEWS, texts, "the tests used photos of different sizes")
    if len(names) < FEWEST:
        return _without(VIEWS, texts, f"the tests have {len(names)} views in common")
    side = _SIDES[compare(values[0] - values[1], UNSEEN_PSNR).finding]
    texts = [f"{float(each.mean()):.2f} dB" for each in values]
    return ComparedFigure(name=VIEWS, first=texts[0], second=texts[1], better=side)


def _confirmed(pairs: _Pairs) -> ComparedFigure | None:
    counts = [_count(side) for side in zip(*pairs, strict=True)] if pairs else [None, None]
    texts = [NONE if count is None else f"{count} of {len(pairs)}" for count in counts]
    if counts[0] is None or counts[1] is None:
        return _without(CONFIRMED, texts, "only one result says which photos are")
    gains = np.array([float(bool(one.confirmed)) - float(bool(other.confirmed)) for one, other in pairs])
    side = _SIDES[compare(gains, PHOTOS_CONFIRMED).finding]
    return ComparedFigure(name=CONFIRMED, first=texts[0], second=texts[1], better=side)


def _count(images: tuple[ImageReport, ...]) -> int | None:
    """How many photos matches or the photo itself confirm; None where nothing was said of any."""
    told = [image.confirmed for image in images if image.confirmed is not None]
    return sum(told) if told else None


def _exact(pairs: _Pairs) -> ComparedFigure | None:
    names, values = _both_known(pairs, _bound_deg, _bound_deg)
    if len(names) < FEWEST:
        sides = [
            np.array([bound for image in side if (bound := _bound_deg(image)) is not None])
            for side in zip(*pairs, strict=True)
        ] or [np.zeros(0)] * 2
        return _without(EXACT, [_text(side, "°") for side in sides], "not both results state it")
    side = _SIDES[compare(octaves(values[1], values[0], LEAST_DEG), STATED_ACCURACY).finding]
    return ComparedFigure(name=EXACT, first=_text(values[0], "°"), second=_text(values[1], "°"), better=side)


def _bound_deg(image: ImageReport) -> float | None:
    return image.uncertainty.rotation_deg if image.uncertainty else None


def _epipolar_px(result: Result) -> Callable[[ImageReport], float | None]:
    kept = result.kept_input
    return lambda image: image.epipolar_px_before if kept else image.epipolar_px_after


def _trial_psnr(result: Result) -> Callable[[ImageReport], float | None]:
    kept = result.kept_input
    return lambda image: image.trial_psnr_before if kept else image.trial_psnr_after


def _given(result: Result) -> bool:
    return result.verdict is not None and result.verdict.compared_with == "given"


def _both_known(
    pairs: _Pairs,
    of_one: Callable[[ImageReport], float | None],
    of_other: Callable[[ImageReport], float | None],
) -> tuple[list[str], tuple[Array, Array]]:
    """The photos of which both values are known, and the values."""
    found = [
        (one.name, a, b)
        for one, other in pairs
        if (a := of_one(one)) is not None and (b := of_other(other)) is not None
    ]
    return [name for name, _, _ in found], (
        np.array([a for _, a, _ in found], np.float64),
        np.array([b for _, _, b in found], np.float64),
    )


def _medians(first: Result, second: Result, pairs: _Pairs) -> list[str]:
    """The matching error of each result by itself."""
    texts = []
    for index, side in enumerate((first, second)):
        of = _epipolar_px(side)
        known = [value for pair in pairs if (value := of(pair[index])) is not None]
        texts.append(_text(np.array(known, np.float64), "px"))
    return texts


def _text(values: Array, unit: str) -> str:
    """The typical value, in words."""
    if not len(values):
        return NONE
    number = (
        f"{float(np.median(values)):.2g}" if np.median(values) < 10 else f"{float(np.median(values)):.0f}"
    )
    return f"± {number}°" if unit == "°" else f"{number} {unit}"


def _without(name: str, texts: list[str], note: str) -> ComparedFigure | None:
    """A measure that does not decide between the two; None where neither result has it."""
    if texts == [NONE, NONE]:
        return None
    return ComparedFigure(name=name, first=texts[0], second=texts[1], note=note)

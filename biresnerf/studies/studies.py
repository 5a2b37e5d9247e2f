"""The paper's studies as predefined comparisons (Guo et al. 2023, Sections 4.1 to 4.3), and a sweep of noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from biresnerf.options.refine_options import parse_options
from biresnerf.studies.plan import Variant, options_of

RESOLUTIONS = (32, 48, 64, 72, 96, 128, 256, 512, 1024, 4096)
LEVELS = (1, 2, 3, 4, 6, 8, 16)
NOISES = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35)
CHECKS_PER_WARMUP = 10  # so that a curve resolves it


@dataclass(frozen=True)
class Study:
    """A predefined comparison.

    Attributes:
        about: what is varied, for the help and the plot's axis.
        swept: the option that differs between the variants; None if it is not a single number.
        variants: of the study; empty if the caller's own are compared.
        noises: default noise levels.
        settings: options of all variants, given the caller's.
    """

    about: str
    swept: str | None
    variants: tuple[Variant, ...]
    noises: tuple[float, ...]
    settings: Callable[[dict[str, Any]], dict[str, Any]]


def _stage_1_only(given: dict[str, Any]) -> dict[str, Any]:
    """All steps belong to the pose-estimation module."""
    steps = parse_options(options_of(given)).resolved("cpu").steps
    return {**given, "steps": steps, "coarse_steps_min": steps, "coarse_steps_max": steps}


def _same_switch(given: dict[str, Any]) -> dict[str, Any]:
    """Stage 2 begins at the cap in all variants, so that their curves differ only from there on."""
    options = parse_options(options_of(given)).resolved("cpu")
    return {
        **given,
        "steps": options.steps,
        "coarse_steps_min": options.coarse_steps_max,
        "coarse_steps_max": options.coarse_steps_max,
        "check_every": max(5, options.warmup_steps // CHECKS_PER_WARMUP),
    }


def _stage_1_sweep(about: str, option: str, symbol: str, values: tuple[int, ...]) -> Study:
    return Study(
        about=f"{about}, stage 1 alone",
        swept=option,
        variants=tuple(Variant(f"{symbol} {value}", {option: value}) for value in values),
        noises=(0.15,),
        settings=_stage_1_only,
    )


STUDIES = {
    "resolution": _stage_1_sweep(
        "largest resolution of the pose-estimation module (cells a side)",
        "pose_resolution_max",
        "N_max",
        RESOLUTIONS,
    ),
    "levels": _stage_1_sweep("levels of the pose-estimation module", "pose_levels", "L", LEVELS),
    "warm-up": Study(
        about="smooth warm-up of the learning rate after the switch, against none",
        swept=None,
        variants=(Variant("smooth warm-up", {}), Variant("no warm-up", {"warmup_steps": 1})),
        noises=(0.15,),
        settings=_same_switch,
    ),
    "noise": Study(
        about="noise of the given poses", swept=None, variants=(), noises=NOISES, settings=lambda given: given
    ),
}

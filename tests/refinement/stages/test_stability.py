"""The stability detector on error curves whose flat part is known."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.refinement.numbers.optimise import SwitchNumbers
from biresnerf.refinement.stages.stability import StabilityDetector

LEAST_CHECKS = SwitchNumbers().least_checks
PERIOD = 200


def run(detector: StabilityDetector, decibels) -> tuple[str, int]:
    """Feeds blocks of mean PSNR until the detector speaks; its word and the step, or ("running", last step)."""
    step = 0
    for block, value in enumerate(decibels):
        step = PERIOD * (block + 1)
        verdict = detector.check(step, 10 ** (-value / 10))
        if verdict != "running":
            return verdict, step
    return "running", step


def approach(time_constant: float, blocks: int, seed: int, noise_db: float = 0.12) -> np.ndarray:
    """12 dB gained exponentially, with noise from block to block."""
    steps = PERIOD * np.arange(1, blocks + 1)
    noise = np.random.default_rng(seed).normal(0, noise_db, blocks)
    return 28 - 12 * np.exp(-steps / time_constant) + noise


def level(blocks: int) -> np.ndarray:
    """12 dB gained at once, and nothing after."""
    return np.array([8.0] + [20.0] * (blocks - 1))


@pytest.mark.parametrize("time_constant", [600, 1000, 2000, 3000])
def test_an_exponential_approach_is_stable_once_less_than_a_decibel_is_left(time_constant):
    found = []
    for seed in range(12):
        verdict, step = run(StabilityDetector(400, 10**9), approach(time_constant, 200, seed))
        assert verdict == "stable"
        found.append(step)
    left = 12 * np.exp(-np.array(found) / time_constant)
    assert np.median(left) < 1.0  # it does not give up early ..
    assert np.median(found) < 8 * time_constant + 2 * LEAST_CHECKS * PERIOD  # .. nor wait for ever


def test_slower_approaches_are_stable_later():
    medians = [
        np.median([run(StabilityDetector(400, 10**9), approach(tau, 200, s))[1] for s in range(12)])
        for tau in (600, 1500, 3500)
    ]
    assert medians == sorted(medians)
    assert medians[0] < medians[-1]


@pytest.mark.parametrize("noise_db", [0.0, 0.1])
def test_an_error_that_falls_as_fast_as_ever_never_counts_as_stable(noise_db):
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0, noise_db, 100)
        assert run(StabilityDetector(400, 10**9), 15 + 0.2 * np.arange(100) + noise)[0] == "running"


@pytest.mark.parametrize("scale", [0.25, 1, 8])
def test_runs_of_any_length_switch_at_the_same_point_of_their_curve(scale):
    checks = np.arange(1, 400)
    curve = 28 - 12 * np.exp(-checks * PERIOD / (1500 * scale))
    verdict, step = run(StabilityDetector(0, 10**9), curve)
    assert verdict == "stable"
    # With q = exp(-x / 2) after x time constants the later half has brought q / (1 + q) of the gain.
    assert step == pytest.approx(-2 * np.log(3 / 17) * 1500 * scale, abs=max(3 * PERIOD, 0.2 * step))


def test_a_rest_before_the_field_forms_is_not_stability():
    """The error of the dome scene rests for some checks, then falls again."""
    curve = [12.3, 15.8, 16.2, 16.4, 17.1, 17.5, 17.9, 19.0, 19.8, 20.4, 21.3, 21.7, 22.3, 22.9, 23.1, 23.5]
    assert run(StabilityDetector(0, 10**9), curve)[0] == "running"


def test_the_cap_ends_stage_1_however_the_error_moves():
    for curve in (15 + 0.2 * np.arange(100), 20 + np.random.default_rng(0).normal(0, 2.0, 100)):
        detector = StabilityDetector(400, 3000)
        assert run(detector, curve) == ("cap", 3000)


def test_nothing_is_stable_before_the_floor():
    assert run(StabilityDetector(9000, 10**9), level(100)) == ("stable", 9000)
    early = run(StabilityDetector(400, 10**9), level(100))
    assert early == ("stable", (LEAST_CHECKS + 1) * PERIOD)  # as soon as it can tell, confirmed once more


def test_a_wildly_fluctuating_error_is_not_stable():
    noise = np.random.default_rng(0).normal(0, 2.0, 100)
    assert run(StabilityDetector(400, 10**9), 20 + noise)[0] != "stable"


def test_one_level_check_is_not_enough():
    detector = StabilityDetector(0, 10**9)
    for block, value in enumerate(level(LEAST_CHECKS)):
        assert detector.check(PERIOD * (block + 1), 10 ** (-value / 10)) == "running"
    assert detector.confirmed == 1
    assert detector.check(PERIOD * (LEAST_CHECKS + 1), 0.5) == "running"
    assert detector.confirmed == 0

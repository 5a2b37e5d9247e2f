"""The stability detector on error curves whose flat part is known."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.refine.stages.stability import WINDOW, StabilityDetector

PERIOD = 200
STILL = 0.0


def run(detector: StabilityDetector, decibels, moved_deg=STILL) -> tuple[str, int]:
    """Feeds blocks of mean PSNR until the detector speaks; its word and the step, or ("running", last step)."""
    step = 0
    for block, value in enumerate(decibels):
        step = PERIOD * (block + 1)
        moved = moved_deg(step) if callable(moved_deg) else moved_deg
        verdict = detector.check(step, 10 ** (-value / 10), moved)
        if verdict != "running":
            return verdict, step
    return "running", step


def approach(time_constant: float, blocks: int, seed: int, noise_db: float = 0.12) -> np.ndarray:
    """12 dB gained exponentially, with noise from block to block."""
    steps = PERIOD * np.arange(1, blocks + 1)
    noise = np.random.default_rng(seed).normal(0, noise_db, blocks)
    return 28 - 12 * np.exp(-steps / time_constant) + noise


@pytest.mark.parametrize("time_constant", [600, 1000, 2000, 3000])
def test_an_exponential_approach_is_stable_once_less_than_a_decibel_is_left(time_constant):
    found = []
    for seed in range(12):
        verdict, step = run(StabilityDetector(400, 10**9), approach(time_constant, 200, seed))
        assert verdict == "stable"
        found.append(step)
    left = 12 * np.exp(-np.array(found) / time_constant)
    assert np.median(left) < 1.0  # it does not give up early ..
    assert np.median(found) < 8 * time_constant + 2 * WINDOW * PERIOD  # .. nor wait for ever


def test_slower_approaches_are_stable_later():
    medians = [
        np.median([run(StabilityDetector(400, 10**9), approach(tau, 200, s))[1] for s in range(12)])
        for tau in (600, 1500, 3500)
    ]
    assert medians == sorted(medians)
    assert medians[0] < medians[-1]


@pytest.mark.parametrize("noise_db", [0.0, 0.1])
def test_an_error_that_keeps_falling_by_a_fifth_of_a_decibel_a_block_never_counts_as_stable(noise_db):
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0, noise_db, 100)
        assert run(StabilityDetector(400, 10**9), 15 + 0.2 * np.arange(100) + noise)[0] == "running"


def test_the_cap_ends_stage_1_however_the_error_moves():
    for curve in (15 + 0.2 * np.arange(100), np.full(100, 20.0)):
        detector = StabilityDetector(400, 3000)
        assert run(detector, curve, moved_deg=10.0) == ("cap", 3000)


def test_nothing_is_stable_before_the_floor():
    assert run(StabilityDetector(9000, 10**9), np.full(100, 20.0)) == ("stable", 9000)
    early = run(StabilityDetector(400, 10**9), np.full(100, 20.0))
    assert early == ("stable", (WINDOW + 1) * PERIOD)  # a full window, confirmed once more


def test_moving_cameras_are_not_stable_though_the_error_is_flat():
    flat = np.full(100, 20.0)
    assert run(StabilityDetector(400, 10**9), flat, moved_deg=1.0)[0] == "running"
    verdict, step = run(StabilityDetector(400, 10**9), flat, lambda step: 1.0 if step < 8000 else 0.0)
    assert verdict == "stable"
    assert 8000 <= step <= 8000 + 2 * PERIOD


def test_a_wildly_fluctuating_error_is_not_stable():
    noise = np.random.default_rng(0).normal(0, 2.0, 100)
    assert run(StabilityDetector(400, 10**9), 20 + noise)[0] != "stable"


def test_one_flat_window_is_not_enough():
    detector = StabilityDetector(0, 10**9)
    for block in range(WINDOW):
        assert detector.check(PERIOD * (block + 1), 0.01, STILL) == "running"
    assert detector.confirmed == 1
    assert detector.check(PERIOD * (WINDOW + 1), 0.01, moved_deg=1.0) == "running"
    assert detector.confirmed == 0


# Medians over 50 curves for time constants 600 to 3500; they span the published switches, 5 000 to 14 600.
CALIBRATED = [5000, 6200, 8000, 9500, 10800, 13000]


def test_time_constants_of_the_approach_give_the_calibrated_switches():
    for tau, expected in zip((600, 1000, 1500, 2000, 2500, 3500), CALIBRATED, strict=True):
        found = []
        for seed in range(15):
            verdict, step = run(StabilityDetector(5000, 10**9), approach(tau, 200, seed + 100))
            assert verdict == "stable"
            assert step % PERIOD == 0
            assert step >= 5000
            found.append(step)
        assert abs(np.median(found) - expected) <= 800


def test_an_unguarded_detector_does_not_wait_for_still_cameras():
    assert run(StabilityDetector(400, 10**9, guarded=False), np.full(60, 20.0), moved_deg=1.0)[0] == "stable"

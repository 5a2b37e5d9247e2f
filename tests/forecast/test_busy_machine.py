"""A run on a busy machine teaches the next forecast nothing wrong: two whole runs, one of them beside seven others."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from biresnerf.commands.poses.inspect import expected_seconds
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.forecast.rates import RATES_FILE, machine_rates
from biresnerf.options.refine_options import RefineOptions

pytestmark = [
    pytest.mark.slow,
    pytest.mark.nightly,
    pytest.mark.skipif(not os.path.exists("/proc/self/schedstat"), reason="needs Linux's schedstat"),
]
OTHERS = 7


def biresnerf(*arguments: object, memory: Path) -> None:
    """Run a command on one core, with a memory of its own."""
    subprocess.run(
        [sys.executable, "-m", "biresnerf.command_line", *map(str, arguments)],
        env=os.environ | {"XDG_CACHE_HOME": str(memory)},
        check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}),
    )


def times(monkeypatch: pytest.MonkeyPatch, scene: Path, memory: Path) -> dict[str, tuple[float, float]]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(memory))
    assert {"coarse step", "fine step"} <= machine_rates("cpu", 1).measured
    return expected_seconds(read_dataset(scene), RefineOptions(threads=1))


def remembered(memory: Path) -> dict[str, float]:
    """The one rate of each unit in a memory, as it was measured: predictions believe it only up to a limit."""
    machines = json.loads((memory / "biresnerf" / RATES_FILE).read_text())
    return {unit: rates[0] for unit, rates in machines["cpu 1"].items()}


def test_predictions_after_a_run_at_load_8_stay_within_twofold(tmp_path, monkeypatch):
    scene, core = tmp_path / "scene", min(os.sched_getaffinity(0))
    biresnerf("make-scene", scene, "--views", 8, "--size", 64, memory=tmp_path)
    quick = [
        *("--preset", "fast", "--set", "steps=300", "--set", "start=given"),
        *("--set", "verdict=false", "--set", "threads=1"),
    ]
    biresnerf("refine", scene, "-o", tmp_path / "a", *quick, memory=tmp_path / "alone")
    hog = f"taskset -c {core} {sys.executable} -S -c 'while True: pass' >/dev/null & echo $!"
    started = [subprocess.run(["sh", "-c", hog], stdout=subprocess.PIPE, check=True) for _ in range(OTHERS)]
    try:
        biresnerf("refine", scene, "-o", tmp_path / "b", *quick, memory=tmp_path / "busy")
    finally:
        for one in started:
            os.kill(int(one.stdout), signal.SIGKILL)
    usual, found = remembered(tmp_path / "alone"), remembered(tmp_path / "busy")
    for step in ("coarse step", "fine step"):
        assert usual[step] / 2 < found[step] < 2 * usual[step]
    alone, busy = times(monkeypatch, scene, tmp_path / "alone"), times(monkeypatch, scene, tmp_path / "busy")
    for preset, (least_s, most_s) in alone.items():
        assert least_s / 2 < busy[preset][0] < 2 * least_s
        assert most_s / 2 < busy[preset][1] < 2 * most_s

"""How accurate the predicted time left is: ``python -m benchmarks.runs.time_left SET... [--preset fast]``.

Each SET holds true poses, which get BARF's noise (0.15). Prints how long each run took, and at 10, 25, 50,
75 and 90 % of that time the predicted seconds to the end over the actual ones. With ``--phases``, a second table gives
each phase's remaining time at these moments (predicted / actual, s); its row ``work`` holds the ratio of the amounts of
work alone, at the general rates, which no load changes. Nothing is remembered from earlier runs. With ``--clock cpu``,
all seconds are processor time, COLMAP's included, of one thread; the forecast uses that clock, too, so that other load
on the machine hardly matters.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal
from unittest import mock

from biresnerf import pipeline
from biresnerf.commands.settings_option import parse_settings
from biresnerf.compile_kernels import compile_kernels
from biresnerf.forecast.run_forecast import RATES, UNITS, Forecast, Phase, Unit
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.options.refine_options import parse_options
from biresnerf.progress import Progress
from biresnerf.studies.scenes import find_scene, read_scene, with_poses

SHARES = (0.1, 0.25, 0.5, 0.75, 0.9)
TICKS = os.sysconf("SC_CLK_TCK")


def processor_s() -> float:
    """Processor seconds of this process and its children, running ones included."""
    spent = os.times()
    return time.process_time() + spent.children_user + spent.children_system + _of_children(os.getpid())


def _of_children(pid: int) -> float:
    """Processor seconds of a process's running descendants."""
    total = 0.0
    try:
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            # The fields after the program's name: user and system time, and those of its children that ended.
            fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
            total += sum(map(int, fields[11:15])) / TICKS + _of_children(int(child))
    except (FileNotFoundError, ProcessLookupError):  # it has ended just now
        pass
    return total


CLOCKS: dict[str, Callable[[], float]] = {"wall": time.monotonic, "cpu": processor_s}


class Watched(Forecast):
    """A forecast that records, at each report, its prediction for each phase and the time taken so far."""

    def __init__(self, rates: Mapping[Unit, float], share: Callable[[float, float], float]) -> None:
        super().__init__(rates, share)
        self.said: list[tuple[float, dict[Phase, float], dict[Phase, float]]] = []
        self.taken: dict[Phase, float] = {}
        self.worked: dict[Phase, float] = {}
        self.amounts: list[
            tuple[float, float, float]
        ] = []  # when, work left and done, s at the general rates

    def enter(self, phase: Phase) -> None:
        super().enter(phase)
        self._entered = time.monotonic()

    def leave(self) -> None:
        if self._phase is not None:
            self.taken[self._phase] = self.taken.get(self._phase, 0.0) + time.monotonic() - self._entered
            self.worked[self._phase] = self.worked.get(self._phase, 0.0) + self.left.get(self._phase, 0.0)
        super().leave()

    def stepped(self, stage: Literal["coarse", "fine"], seconds: float) -> None:
        self.taken[stage] = self.taken.get(stage, 0.0) + seconds
        self.worked[stage] = self.worked.get(stage, 0.0) + self.step_weights[stage]
        super().stepped(stage, seconds)

    def now(self) -> tuple[float, float | None]:
        when, phase = time.monotonic(), self._phase
        self.said.append((when, {p: self.seconds(p) for p in self.left}, dict(self.taken)))
        left, done = dict(self.left), dict(self.worked)
        if phase is not None and phase in left:
            done[phase] = done.get(phase, 0.0) + self._done * left[phase]
            left[phase] = (1 - self._done) * left[phase] + self._later
        self.amounts.append((when, at_general_rates(left), at_general_rates(done)))
        return super().now()

    def work_at(self, moment: float) -> float:
        """After the run: the ratio of predicted to actual work from a moment on."""
        _, left, done = self.amounts[max(0, bisect_right([when for when, _, _ in self.amounts], moment) - 1)]
        return left / max(at_general_rates(self.worked) - done, 1e-9)

    def phases_at(self, moment: float) -> dict[Phase, tuple[float, float]]:
        """After the run: each phase's seconds from a moment on, predicted and actual."""
        _, said, taken = self.said[max(0, bisect_right([when for when, _, _ in self.said], moment) - 1)]
        rest = {phase: seconds - taken.get(phase, 0.0) for phase, seconds in self.taken.items()}
        return {p: (said.get(p, 0.0), rest.get(p, 0.0)) for p in UNITS if said.get(p) or rest.get(p)}


def told_and_taken(
    path: Path, preset: str, noise: float, settings: Mapping[str, Any], clock: str = "wall"
) -> tuple[float, list[float | None], list[dict[Phase, tuple[float, float]]], list[float]]:
    """A run's seconds, its ratios of predicted to actual time left, both for each phase, and its ratios of work."""
    truth = read_scene(find_scene(path, 1, test_views=0))
    given = with_poses(truth, perturb_poses(truth.world_from_cam, noise, seed=1))
    told: list[tuple[float, float | None]] = []
    made: list[Watched] = []

    def listen(progress: Progress) -> None:
        told.append((time.monotonic(), progress.eta_s))

    def forecast(rates: Mapping[Unit, float], share: Callable[[float, float], float]) -> Watched:
        made.append(Watched(rates, share))
        return made[-1]

    if clock == "cpu":
        settings = {"threads": 1, **settings}
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(time, "monotonic", CLOCKS[clock]),
        mock.patch.object(pipeline, "Forecast", forecast),
        tempfile.TemporaryDirectory() as memory,
        mock.patch.dict(os.environ, {"XDG_CACHE_HOME": memory}),
    ):
        began = time.monotonic()
        pipeline.refine_poses(given, Path(folder), parse_options({"preset": preset, **settings}), listen)
        seconds = time.monotonic() - began
    ratios: list[float | None] = []
    for share in SHARES:
        now = began + share * seconds
        at, eta_s = told[max(0, bisect_right([when for when, _ in told], now) - 1)]
        left_s = None if eta_s is None else eta_s - (now - at)
        ratios.append(None if left_s is None else left_s / ((1 - share) * seconds))
    moments = [began + share * seconds for share in SHARES]
    return seconds, ratios, [*map(made[0].phases_at, moments)], [*map(made[0].work_at, moments)]


def at_general_rates(amounts: Mapping[Phase, float]) -> float:
    """The seconds of one core that these amounts of work take."""
    return sum(amount * RATES[UNITS[phase]] for phase, amount in amounts.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--phases", action="store_true")
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="an option of the runs"
    )
    options = parser.parse_args()
    compile_kernels(field=True)
    print("| set | seconds |" + "".join(f" at {share:.0%} |" for share in SHARES))
    print("|---|---|" + "---|" * len(SHARES))
    for path in options.sets:
        settings = parse_settings(tuple(options.set))
        seconds, ratios, phases, work = told_and_taken(
            path, options.preset, options.noise, settings, options.clock
        )
        cells = "".join(" - |" if ratio is None else f" {ratio:.2f} |" for ratio in ratios)
        print(f"| {path.name} | {seconds:.0f} |{cells}", flush=True)
        for phase in UNITS if options.phases else ():
            both = (found.get(phase) for found in phases)
            cells = "".join(" |" if one is None else f" {one[0]:.1f} / {one[1]:.1f} |" for one in both)
            print(f"| | {phase} |{cells}", flush=True)
        if options.phases:
            print("| | work |" + "".join(f" {ratio:.2f} |" for ratio in work), flush=True)


if __name__ == "__main__":
    main()

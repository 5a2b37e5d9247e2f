"""Seconds per unit of work on this machine, measured by its runs and kept from one run to the next."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low

from pydantic import PositiveFloat, TypeAdapter

from biresnerf.forecast.run_forecast import RATES, UNITS, Phase, Unit

logger = logging.getLogger(__name__)

RATES_FILE = "rates.json"
_REMEMBERED = TypeAdapter(dict[str, dict[str, list[PositiveFloat]]])
# Runs that are remembered; the middle one counts, so that two outliers do not matter.
KEPT = 5
# A rate that is further from the general one is not believed. No general rates of GPUs are known.
CREDIBLE = 3.0
# How far general rates may be off: the time on this machine over theirs. Three hosts took 2/3, 3/2 and 3.
UNKNOWN = (2 / 3, 3.0)


@dataclass(frozen=True)
class MachineRates:
    """Seconds of each unit of work on one machine.

    Attributes:
        measured: units whose rates were measured there; the others are general ones.
    """

    seconds: Mapping[Unit, float]
    measured: frozenset[Unit]

    def between(self, amounts: Mapping[Phase, float]) -> tuple[float, float]:
        """The least and the most seconds that so much work of each phase takes; the same where all was measured."""
        known = sum(a * self.seconds[UNITS[p]] for p, a in amounts.items() if UNITS[p] in self.measured)
        rest = sum(a * self.seconds[UNITS[p]] for p, a in amounts.items()) - known
        least, most = UNKNOWN
        return known + least * rest, known + most * rest


def machine_rates(device: str, threads: int) -> MachineRates:
    """The rates of a kind of device with so many threads."""
    general = {unit: rate / threads for unit, rate in RATES.items()}
    runs = _read().get(f"{device} {threads}", {})
    known = {unit: median_low(runs[unit]) for unit in general if runs.get(unit)}
    if device == "cpu":
        known = {
            unit: min(max(rate, general[unit] / CREDIBLE), general[unit] * CREDIBLE)
            for unit, rate in known.items()
        }
    return MachineRates(general | known, frozenset(known))


def latest_machine(threads: int) -> tuple[str, int]:
    """The kind of device of the latest run here, and its threads: ``threads`` if any run on it used as many."""
    names = [name.split(" ") for name in _read()]
    known = [(name[0], int(name[1])) for name in names if len(name) == 2 and name[1].isdecimal()]
    if not known:
        return "cpu", threads
    device, _ = known[-1]
    return (device, threads) if (device, threads) in known else known[-1]


def remember_rates(device: str, threads: int, rates: Mapping[Unit, float]) -> None:
    """Keep what a run measured, for the next. Where nothing can be written, nothing is kept."""
    machines = _read()
    known = machines.pop(f"{device} {threads}", {})
    machines[f"{device} {threads}"] = known  # the latest comes last
    for unit, rate in rates.items():
        known[unit] = [*known.get(unit, []), rate][-KEPT:]
    path = cache_folder() / RATES_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{RATES_FILE}.{os.getpid()}")
        temporary.write_text(json.dumps(machines, indent=1), "utf-8")
        temporary.replace(path)
    except OSError as error:
        logger.debug("rates are not kept: %s", error)


def cache_folder() -> Path:
    """The folder for what was measured on this machine."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base, "biresnerf")


def _read() -> dict[str, dict[str, list[float]]]:
    """Seconds of each unit by machine, the latest run last; empty if the file is damaged."""
    try:
        return _REMEMBERED.validate_json((cache_folder() / RATES_FILE).read_bytes())
    except (OSError, ValueError):
        return {}

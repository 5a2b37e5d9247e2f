"""Plant the faults of faults.json one at a time, and see their tests fail.

    python -m tests.mutants                      # all; exit status 1 if one survives, or its line is gone
    python -m tests.mutants --draw 20 --seed 3   # plant new ones; those that a test finds join faults.json

Each fault changes one line of a copy of the tracked files. Its test runs there twice: with the line as it was, when it
must pass (all tests in one process), and with the fault, when it must fail or never end. Slow tests, and those that
need a server, have no part.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from biresnerf.frozen_model import FrozenModel
from tests.mutants.draw import drawn_faults

ROOT = Path(__file__).parents[2]
KEPT = Path(__file__).with_name("faults.json")
LONGEST_S = 120
FAST = "not server and not browser and not slow and not nightly"  # as of `make test-fast`
Outcome = Literal["found", "survived", "gone", "no green test"]


class PlantedFault(FrozenModel):
    """A line of a file that is replaced by another one, and the test that must see it."""

    file: str
    old: str
    new: str
    test: str


FAULTS = TypeAdapter(tuple[PlantedFault, ...])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draw", type=int, default=0, help="How many new ones.")
    parser.add_argument("--seed", type=int, default=0, help="Of the new ones.")
    asked = parser.parse_args()
    kept = FAULTS.validate_json(KEPT.read_bytes()) if KEPT.exists() else ()
    with tempfile.TemporaryDirectory(prefix="biresnerf-mutants-") as folder:
        copy = Path(folder)
        _copy_tracked(copy)
        if not asked.draw:
            outcomes = [outcome for _, outcome in _planted(kept, copy)]
            print(dict(Counter(outcomes)))
            return int(set(outcomes) != {"found"})
        known = {(fault.file, fault.old) for fault in kept}
        fresh = [
            PlantedFault(**fault)
            for fault in drawn_faults(ROOT, random.Random(asked.seed), asked.draw)
            if (fault["file"], fault["old"]) not in known
        ]
        for fault, outcome in _planted(fresh, copy):
            if outcome == "found":  # written at once: a run that is stopped keeps what it found
                kept = (*kept, fault)
                KEPT.write_bytes(FAULTS.dump_json(kept, indent=1) + b"\n")
    return 0


def _copy_tracked(to: Path) -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in listed.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)


def _planted(faults: Iterable[PlantedFault], copy: Path) -> Iterable[tuple[PlantedFault, Outcome]]:
    faults = tuple(faults)
    green = _green({fault.test for fault in faults}, copy)
    for fault in faults:
        outcome = _outcome(fault, copy, green)
        print(
            f"{outcome}: {fault.file}: {fault.old.strip()} -> {fault.new.strip()} ({fault.test})", flush=True
        )
        yield fault, outcome


def _outcome(fault: PlantedFault, copy: Path, green: set[str]) -> Outcome:
    file = copy / fault.file
    if not file.exists():
        return "gone"
    source = file.read_text()
    lines = source.split("\n")
    if lines.count(fault.old) != 1:
        return "gone"
    if fault.test not in green:
        return "no green test"
    lines[lines.index(fault.old)] = fault.new
    file.write_text("\n".join(lines))
    try:
        run = _pytest(["-x", fault.test], copy, LONGEST_S)
    finally:
        file.write_text(source)
    return "survived" if run is not None and run.returncode == 0 else "found"


def _green(tests: set[str], copy: Path) -> set[str]:
    """Those of the tests, files or single ones, of which some part is fast, and all that is passes in the copy."""
    run = _pytest(["-rA", "--continue-on-collection-errors", *sorted(tests)], copy, LONGEST_S * len(tests))
    said = "" if run is None else run.stdout.decode()
    told = re.findall(r"^(PASSED|FAILED|ERROR) (\S+)", said, re.MULTILINE)

    def passes(test: str) -> bool:
        words = {word for word, name in told if re.match(re.escape(test) + r"($|\[|::)", name)}
        return words == {"PASSED"}

    return set(filter(passes, tests))


def _pytest(chosen: list[str], copy: Path, longest_s: float) -> subprocess.CompletedProcess[bytes] | None:
    """What a run of the chosen tests in the copy said; None of one that does not end."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", "-m", FAST, *chosen]
    # Bytecode knows a file by its time in whole seconds and its size: a fault could be overlooked.
    around = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        return subprocess.run(
            command, cwd=copy, env=around, capture_output=True, timeout=longest_s, check=False
        )
    except subprocess.TimeoutExpired:
        return None


if __name__ == "__main__":
    sys.exit(main())

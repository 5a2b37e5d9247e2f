"""Concurrent jobs do not occupy each other's cores by busy waiting."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ENTRANCES = {
    "library": "import biresnerf\ntry: biresnerf.refine('none', 'out')\nexcept biresnerf.InputError: import torch",
    "command line": "from biresnerf.command_line import main\ntry: main()\nexcept SystemExit: import torch",
    "job": "import pathlib; from workers.run.job_process import main; main(pathlib.Path()); import torch",
}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that finds no order leaves a file that says so where it runs."""
    monkeypatch.chdir(tmp_path)


def spins(program: str, **variables: str) -> list[int]:
    """How often the threads of each libgomp that ``program`` loads look for work before they sleep."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))
    }
    ran = subprocess.run(
        [sys.executable, "-c", program], env={**environment, "OMP_DISPLAY_ENV": "verbose", **variables},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [int(count) for count in re.findall(r"GOMP_SPINCOUNT = '(\d+)'", ran.stderr)]


@pytest.mark.parametrize("entrance", ENTRANCES)
def test_waiting_threads_sleep(entrance):
    if not spins("import torch"):
        pytest.skip("torch's OpenMP is not libgomp here")
    assert set(spins(ENTRANCES[entrance])) == {0}


def test_what_the_user_says_of_threads_holds():
    said = spins(ENTRANCES["library"], OMP_WAIT_POLICY="active")
    if not said:
        pytest.skip("torch's OpenMP is not libgomp here")
    assert min(said) > 0

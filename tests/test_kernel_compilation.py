"""The first run on a machine: other processes compile its kernels while it reads photos, and later runs need none."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.nightly]
# Counts what this process compiles itself.
REFINE = """
import sys
from numba.core import event
from biresnerf.run.refine import refine
compiled = []
class Listener(event.Listener):
    def on_start(self, happened): compiled.append(happened.data["dispatcher"].py_func.__qualname__)
    def on_end(self, happened): pass
event.register("numba:compile", Listener())
options = dict(preset="fast", steps=60, max_image_size=32, start="given", verdict=False)
refine(sys.argv[1], sys.argv[2], progress=True, **options)
print("compiled", len(compiled), *compiled[:5])
"""


def test_a_run_compiles_nothing_itself_and_the_next_starts_no_process_for_it(tmp_path):
    scene = tmp_path / "scene"
    make = f"-m biresnerf.command_line make-scene {scene} --views 6 --size 32"
    subprocess.run([sys.executable, *make.split()], check=True)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "XDG_CACHE_HOME": str(tmp_path)}

    def run(output: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", REFINE, str(scene), str(output)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)

    first = run(tmp_path / "first")
    assert "compiles kernels" in first.stderr
    (stamp,) = (tmp_path / "kernels").glob("compiled-*")
    assert re.search(r"compiled (\d+)", first.stdout)[1] == "0", first.stdout
    assert waits(tmp_path / "first"), "the wait is a part of the run's time"
    second = run(tmp_path / "second")
    assert "compiles kernels" not in second.stderr
    assert stamp.exists()
    assert not waits(tmp_path / "second")


def waits(output: Path) -> bool:
    """Whether the report tells of time spent on waiting for kernels."""
    return json.loads((output / "report.json").read_text())["seconds"].get("compiling", 0.0) > 0

"""What processes of ours do not load, and how little memory an idle slot takes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.workers.conftest import ROOT
from workers.run.child import Child

HEAVY = ("torch", "numpy", "numba", "pycolmap", "PIL")


@pytest.mark.parametrize(
    "module", ["workers.queue.slot", "workers.engine", "workers.upkeep.supervise", "workers.run.job_process"]
)
def test_importing_it_loads_no_heavy_library(module: str):
    program = f"import sys, {module}; print([name for name in {HEAVY!r} if name in sys.modules])"
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert said.stdout.strip() == "[]"


def test_the_tether_kills_the_program_when_its_parent_dies(tmp_path):
    program = f"""
import subprocess, sys, time
from workers.process.die_with_parent import dying_with_parent
child = subprocess.Popen(dying_with_parent(["sleep", "600"], signal_number=9))
open({str(tmp_path / "pid")!r}, "w").write(str(child.pid))
time.sleep(0.5)
"""
    import psutil

    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)
    pid = int((tmp_path / "pid").read_text())
    for _ in range(50):
        if not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
            return
        psutil.wait_procs([psutil.Process(pid)], timeout=0.1)
    raise AssertionError("the program outlived its parent")


@pytest.mark.anyio
async def test_a_job_gives_way_to_the_service_also_where_each_session_is_scheduled_as_a_group(tmp_path: Path):
    group = Path("/proc/self/autogroup")
    said = "import os, pathlib; print(os.nice(0), pathlib.Path('/proc/self/autogroup').read_text())"
    program = said if group.exists() else "import os; print(os.nice(0), 'nice 7')"
    before = group.read_text() if group.exists() else ""
    child = await Child.start((sys.executable, "-c", program), tmp_path, tmp_path / "log", {}, nice=7)
    lines = [line.decode().split() async for line in child.lines()]
    assert await child.wait() == 0
    assert lines[0][0] == str(os.nice(0) + 7)
    assert lines[0][-2:] == ["nice", "7"]
    assert not group.exists() or group.read_text() == before, "our own group stays as it was"

"""The real method through the whole service, on a scene small enough for seconds."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.report import Report
from tests.service.conftest import PATIENCE_S

pytestmark = pytest.mark.server

COMMAND = (sys.executable, "-m", "biresnerf.command_line", "demo")
SMALL = ("--views", "8", "--size", "32", "--set", "steps=60", "--set", "orbit_frames=2")


def demo(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=240)


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "out"
    done = demo("--output", folder, *SMALL)
    assert done.returncode == 0, done.stderr
    (folder / "said.txt").write_text(done.stdout)
    (folder / "progress.txt").write_text(done.stderr)
    return folder


def test_the_demo_tells_errors_quality_and_where_things_are(output: Path) -> None:
    said = (output / "said.txt").read_text()
    assert re.search(r"http://127\.0\.0\.1:\d+/docs", said)
    before, after = (float(value) for value in re.search(r"rotation +([\d.]+)° +([\d.]+)°", said).groups())  # type: ignore[union-attr]
    assert 5 < before < 30
    assert after > 0
    assert re.search(r"position, of camera distance +[\d.]+% +[\d.]+%", said)
    assert re.search(r"PSNR \d+\.\d+ dB", said)
    assert "transforms.json" in said
    assert re.search(r"(coarse|fine) .*step \d+/60 .*left", (output / "progress.txt").read_text())


def test_the_result_holds_everything_in_the_users_names(output: Path) -> None:
    result = output / "result"
    report = Report.model_validate_json((result / "report.json").read_bytes())
    assert (report.state, report.options.steps) == ("complete", 60)
    given, refined = read_poses(output / "scene"), read_poses(result)
    assert list(given) == list(refined)
    assert all(np.allclose(np.linalg.det(pose[:3, :3]), 1.0) for pose in refined.values())
    documents = [
        json.loads((folder / "transforms.json").read_text()) for folder in (output / "scene", result)
    ]
    names = [[frame["file_path"] for frame in document["frames"]] for document in documents]
    assert names[0] == names[1] == [image.name for image in report.images]
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (result / "colmap" / "sparse" / "0" / name).is_file()
    assert (result / "renders" / "orbit.mp4").stat().st_size > 0
    assert not list(result.rglob("*.part"))


def test_a_second_run_replaces_the_first_and_foreign_files_are_safe(output: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    done = demo("--output", tmp_path, *SMALL)
    assert done.returncode == 2
    assert "did not write" in done.stderr
    assert (tmp_path / "thesis.txt").read_text() == "years of work"
    # Refused before anything of an earlier run is touched.
    done = demo("--scene", tmp_path / "nothing", "--output", output)
    assert done.returncode == 2
    assert (output / "result" / "report.json").is_file()


def _below(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def _command(process: psutil.Process) -> str:
    with contextlib.suppress(psutil.Error):  # gone since
        return " ".join(process.cmdline())
    return ""


def test_a_killed_demo_takes_its_service_with_it(tmp_path: Path, scene: Path) -> None:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "TMPDIR": str(tmp_path)}
    tmp_path.chmod(0o711)  # the database runs as another user where root starts it
    process = subprocess.Popen(
        [*COMMAND, "--output", str(tmp_path / "out"), "--scene", str(scene)],
        stdout=subprocess.PIPE,
        env=environment,
    )
    assert process.stdout is not None
    assert b"http://" in process.stdout.readline()
    below = _below(process)
    assert len(below) >= 4  # supervisor, database, API, worker
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(below, timeout=PATIENCE_S)
    assert alive == []


def test_ctrl_c_leaves_no_process_and_no_folder(tmp_path: Path, scene: Path) -> None:
    homes = set(Path(tempfile.gettempdir()).glob("biresnerf-temporary-*"))
    process = subprocess.Popen(
        [*COMMAND, "--output", str(tmp_path / "out"), "--scene", str(scene), "--set", "steps=100000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    assert b"http://" in process.stdout.readline()
    end = time.monotonic() + PATIENCE_S
    below = _below(process)
    while not any("workers.run.job_process" in said for said in map(_command, below)):
        assert time.monotonic() < end, "the job did not start"
        time.sleep(0.1)
        below = _below(process)
    assert len(below) >= 5  # supervisor, database, API, worker, job
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S + 30)
    assert process.returncode == 130, said
    _, alive = psutil.wait_procs(below, timeout=5)
    assert alive == []
    assert set(Path(tempfile.gettempdir()).glob("biresnerf-temporary-*")) == homes

"""The real job program and the real check program, on a small synthetic scene."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Progress
from tests.workers.conftest import ROOT, Counting, Slots, quick_settings, ready_dataset
from workers.engine import open_stores
from workers.process.disk_space import EXIT_DISK
from workers.records import PHOTO_LIST, shown_folder
from workers.run.job_process import is_out_of_memory

pytestmark = pytest.mark.server

SMALL = RefineOptions(
    preset="fast",
    steps=300,
    max_image_size=32,
    samples_per_step=2048,
    reconstruction_levels=2,
    table_size_log2=12,
    checkpoint_every_s=1,
    orbit_frames=2,
    start="given",  # neither COLMAP nor a verdict: what is shown here is that work goes on
    verdict=False,
    threads=1,
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    write_synthetic_scene(folder, 6, 32, seed=1)
    return folder


def files_of(scene: Path) -> dict[str, bytes]:
    return {
        path.relative_to(scene).as_posix(): path.read_bytes() for path in scene.rglob("*") if path.is_file()
    }


def job_folder(tmp_path: Path, scene: Path, options: dict[str, object]) -> Path:
    folder = tmp_path / "job"
    folder.mkdir()
    (folder / "input").symlink_to(scene)
    (folder / "job.json").write_text(json.dumps({"input": "input", "output": "output", "options": options}))
    return folder


def run(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "workers.run.job_process", str(folder)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_sigterm_checkpoints_and_the_next_run_goes_on(tmp_path: Path, scene: Path):
    folder = job_folder(tmp_path, scene, SMALL.model_copy(update={"steps": 20_000}).model_dump())
    process = run(folder)
    assert process.stdout is not None
    kept, told = None, False
    for line in process.stdout:
        progress = Progress.model_validate_json(line)
        kept = progress if progress.checkpoint else kept
        if progress.step >= 20 and not told:
            told = True
            process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    assert process.returncode == 143
    assert kept is not None
    assert kept == progress, "the checkpoint written at the signal is reported, or nobody would keep it"
    assert (folder / "output" / str(kept.checkpoint)).is_file()
    again = run(folder)
    assert again.stdout is not None
    steps = []
    for line in again.stdout:
        progress = Progress.model_validate_json(line)
        if progress.stage == "coarse":
            steps.append(progress.step)
            again.kill()
    again.communicate()
    assert steps[0] >= kept.step


def test_a_users_mistake_ends_with_2_and_says_what_to_fix(tmp_path: Path, scene: Path):
    folder = job_folder(tmp_path, scene, {"steps": 1})
    process = run(folder)
    process.communicate(timeout=60)
    assert process.returncode == 2
    said = json.loads((folder / "error.json").read_text())
    assert said["code"] == "invalid_options"
    assert "steps" in said["detail"]


@pytest.mark.parametrize(
    ("work", "wants"),
    [
        (lambda: np.empty(2**59, np.uint8), True),
        (lambda: torch.empty(2**59, dtype=torch.uint8), True),
        (lambda: torch.cat([torch.zeros(2, 3), torch.zeros(2, 4)]), False),
        (lambda: Path("/proc/nothing").read_text(), False),
    ],
    ids=["numpy", "torch", "shapes", "file"],
)
def test_want_of_memory_is_told_from_other_errors(work: Callable[[], object], wants: bool):
    with pytest.raises((MemoryError, RuntimeError, OSError)) as caught:
        work()
    assert is_out_of_memory(caught.value) == wants


def test_the_check_names_the_broken_image(tmp_path: Path, scene: Path):
    folder = tmp_path / "dataset"
    for path, content in files_of(scene).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)
    command = [sys.executable, "-m", "workers.datasets.dataset_check_process", str(folder)]
    good = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert good.returncode == 0
    *reads, answer = map(json.loads, good.stdout.splitlines())
    assert reads == [{"photos_read": count, "photos": 6} for count in range(7)]
    assert answer["report"]["images"] == 6
    for number in range(2, 6):
        (folder / "train" / f"r_{number}.png").write_bytes(b"no image")
    bad = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert bad.returncode == 2
    error = json.loads(bad.stdout.splitlines()[-1])["error"]
    assert "r_2" in error["where"]
    assert str(folder) not in bad.stdout


def test_a_full_disk_is_no_fault_of_the_files_that_are_checked(tmp_path: Path, scene: Path):
    folder = tmp_path / "dataset"
    shutil.copytree(scene, folder)
    (shown := shown_folder(folder)).mkdir()
    (shown / PHOTO_LIST).symlink_to("/dev/full")
    command = [sys.executable, "-m", "workers.datasets.dataset_check_process", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == EXIT_DISK, done.stderr
    assert "error" not in done.stdout


@pytest.mark.anyio
async def test_a_real_job_survives_the_kill_of_its_process(
    database_url: str, tmp_path: Path, scene: Path, slots: Slots
):
    settings = quick_settings(
        tmp_path / "data",
        database_url=database_url,
        job_command=(sys.executable, "-m", "workers.run.job_process"),
        check_command=(sys.executable, "-m", "workers.datasets.dataset_check_process"),
    )
    slots.start(settings, "a")
    async with open_stores(settings) as stores:
        dataset_id = await ready_dataset(stores, files_of(scene))
        job, _ = await stores.jobs.submit(dataset_id, SMALL)
        watched = Counting(stores, tmp_path / "journal")
        watched.id = job.id
        async for update in stores.jobs.subscribe(job.id):
            if update is not None and any(event.type == "checkpoint" for event in update.events):
                break
        os.kill(only_child(slots), signal.SIGKILL)
        done = await watched.until_final(timeout_s=120)
        assert done.error is None
        assert (done.state, done.attempt) == ("succeeded", 2)
        events = (await stores.jobs.update(job.id)).events
        assert [e.data["resumed"] for e in events if e.type == "started"] == [False, True]
        stages = [e.data["stage"] for e in events if e.type == "stage" and e.attempt == 2]
        assert stages[0] == "preparing"
        assert stages[-1] == "exporting"
        assert done.progress.step == done.progress.steps_total > 0, "it shows all its steps at the end"
        names = {item.name for item in await stores.jobs.artifacts(job.id)}
        assert {
            "transforms.json",
            "report.json",
            "config.json",
            "log.txt",
            "colmap/sparse/0/images.bin",
            "poses.json",
            "tum.txt",
            "scene.glb",
        } <= names
        report = await watched.result()
        assert report["state"] == "complete"
        assert isinstance(done.metrics, dict)


def only_child(slots: Slots) -> int:
    """The job's process of the only slot."""
    import psutil

    (child,) = psutil.Process(slots.processes[0].pid).children()
    return child.pid


def run_with_site(folder: Path, site: str) -> subprocess.CompletedProcess[str]:
    """The job program, with `site` run first."""
    (folder / "sitecustomize.py").write_text(site)
    variables = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-m", "workers.run.job_process", str(folder)]
    return subprocess.run(command, env=variables, capture_output=True, text=True, check=False, timeout=120)


def test_a_disk_that_is_full_is_an_end_of_its_own(tmp_path: Path, scene: Path):
    folder = job_folder(tmp_path, scene, {"preset": "fast"})
    (folder / "error.json").symlink_to("/dev/full")
    (folder / "input").unlink()
    (folder / "input").mkdir()  # without photos, which is to be written to error.json
    done = run_with_site(folder, "")
    assert done.returncode == EXIT_DISK, done.stderr


def test_a_traceback_is_for_the_operator_alone(tmp_path: Path, scene: Path):
    folder = job_folder(tmp_path, scene, {"preset": "fast"})
    done = run_with_site(folder, "import sys\nsys.modules['biresnerf.pipeline'] = None\n")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert str(ROOT) not in done.stderr
    assert "The program failed (ModuleNotFoundError)" in done.stderr
    assert "Traceback" in (folder / "crash.txt").read_text()

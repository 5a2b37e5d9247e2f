"""A run removes only what a finished run wrote to its output folder, and keeps other runs out while it writes."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import InputError, Interrupted
from biresnerf.pipeline import refine_poses
from biresnerf.stages import CHECKPOINT
from biresnerf.write.output_folder import REPORT, OutputFolder
from tests.refinement.tiny_scene import tiny_run


def folder_of_the_user(path: Path) -> set[Path]:
    for name in (
        "transforms.json",
        "colmap/sparse/0/cameras.txt",
        "renders/mine.png",
        CHECKPOINT.parent / "notes.txt",
    ):
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("the user's own")
    return set(path.rglob("*"))


def test_nothing_is_removed_from_a_folder_without_a_finished_result(tmp_path):
    before = folder_of_the_user(tmp_path)
    folder = OutputFolder(tmp_path)
    folder.remove_result()
    assert set(tmp_path.rglob("*")) == before
    with pytest.raises(InputError) as caught:
        folder.refuse_finished()
    assert caught.value.code == "output_not_empty"


def test_a_finished_result_goes_whole_and_the_users_files_beside_it_stay(tmp_path):
    folder_of_the_user(tmp_path)
    (tmp_path / REPORT).write_text("{}")
    (tmp_path / "thesis.tex").write_text("mine")
    OutputFolder(tmp_path).remove_result()
    assert {path.name for path in tmp_path.iterdir()} == {"thesis.tex"}


@pytest.mark.slow
def test_a_second_run_is_refused_the_folder_until_the_first_ends(tmp_path):
    scene = write_synthetic_scene(tmp_path / "scene", 12, 24, seed=3)
    options, output = tiny_run(start="given"), tmp_path / "out"
    codes = []

    def try_another() -> bool:
        with pytest.raises(InputError) as caught:
            refine_poses(scene, output, options)
        codes.append(caught.value.code)
        return len(codes) == 3

    with pytest.raises(Interrupted):
        refine_poses(scene, output, options, should_stop=try_another)
    assert codes == ["output_in_use"] * 3
    assert refine_poses(scene, output, options).state == "complete"


def test_a_killed_run_leaves_the_folder_to_others(tmp_path):
    program = (
        "import sys, time; from biresnerf.write.output_folder import OutputFolder\n"
        "with OutputFolder(sys.argv[1]).held(): print('held', flush=True); time.sleep(600)"
    )
    run = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert run.stdout is not None
        assert run.stdout.readline() == b"held\n"
        with pytest.raises(InputError) as caught, OutputFolder(tmp_path).held():
            pass
        assert caught.value.code == "output_in_use"
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    with OutputFolder(tmp_path).held():
        pass


def test_a_folder_that_a_failed_run_made_does_not_stay(tmp_path):
    with pytest.raises(RuntimeError), OutputFolder(tmp_path / "new").held():
        raise RuntimeError
    with pytest.raises(RuntimeError), OutputFolder(tmp_path).held():
        raise RuntimeError
    assert list(tmp_path.parent.glob("*/new")) == []
    assert tmp_path.is_dir()

"""`biresnerf.refine` as a program and a notebook use it: what it gives, what it refuses, how it is stopped."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import biresnerf
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.data.synthetic.scene import write_synthetic_scene
from tests.commands.poses.test_refine import SETTINGS

pytestmark = pytest.mark.slow
OPTIONS = {**SETTINGS, "steps": 40, "start": "none", "shown_views": 0}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    write_synthetic_scene(folder, 6, 24, seed=1)
    return folder


def test_the_result_is_what_lies_in_the_folder(scene, tmp_path):
    told = []
    result = biresnerf.refine(str(scene), str(tmp_path / "out"), progress=told.append, **OPTIONS)
    files = read_poses(tmp_path / "out/transforms.json")
    assert [name.removeprefix("./") for name in result.names] == list(files)
    assert (result.poses.dtype, result.poses.shape) == (np.float64, (6, 4, 4))
    np.testing.assert_allclose(result.poses, np.stack(list(files.values())), atol=1e-12)
    np.testing.assert_allclose(result.poses_before, np.stack(list(read_poses(scene).values())), atol=1e-12)
    assert result.report.options.steps == 40
    assert [p.fraction for p in told] == sorted(p.fraction for p in told)
    assert told[-1].fraction == 1.0
    assert f"<title>{scene.name}</title>" in (tmp_path / "out/report.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("input", "options", "code", "said"),
    [
        ("scene", {"step": 30}, "invalid_options", "step: unknown option (did you mean `steps`?)."),
        ("scene", {"steps": 3}, "invalid_options", "greater than or equal to 20"),
        ("nowhere", {}, "input_missing", "does not exist"),
    ],
)
def test_what_is_wrong_is_told_before_torch_is_loaded(scene, tmp_path, input, options, code, said):
    program = f"""
import sys, biresnerf
try:
    biresnerf.refine({str(scene.with_name(scene.name if input == "scene" else input))!r}, "out", **{options!r})
except biresnerf.InputError as error:
    print(error.code, error)
assert "torch" not in sys.modules
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[0] == code
    assert said in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_is_kept_for_the_next_call_and_then_does_what_it_did(scene, tmp_path):
    before = signal.getsignal(signal.SIGINT)

    def interrupt(progress: biresnerf.Progress) -> None:
        if progress.step:
            signal.raise_signal(signal.SIGINT)

    def interrupt_once(progress: biresnerf.Progress) -> None:
        if progress.step and not stopped:
            stopped.append(progress.step)
            signal.raise_signal(signal.SIGINT)

    stopped: list[int] = []
    with pytest.raises(biresnerf.Interrupted):
        biresnerf.refine(scene, tmp_path / "out", progress=interrupt_once, **OPTIONS)
    assert signal.getsignal(signal.SIGINT) is before
    assert biresnerf.load(tmp_path / "out").report.state == "partial"
    with pytest.raises(KeyboardInterrupt):  # the second time at once
        biresnerf.refine(scene, tmp_path / "other", progress=interrupt, **OPTIONS)
    result = biresnerf.refine(scene, tmp_path / "out", **OPTIONS)
    assert (result.report.state, result.report.resumed) == ("complete", 1)


def test_it_runs_in_a_thread_where_there_are_no_signals(scene, tmp_path):
    found = []
    work = threading.Thread(target=lambda: found.append(biresnerf.refine(scene, tmp_path / "out", **OPTIONS)))
    work.start()
    work.join()
    assert found[0].report.state == "complete"

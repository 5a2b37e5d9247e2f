"""The programs that make and start the image. `make compose-check` builds and runs it."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
DOCKERFILE = (DEPLOY.parent / "Dockerfile").read_text().replace("\\\n", " ")


def loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DEPLOY / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_image_is_started_and_examined_without_a_shell_and_not_by_root():
    started = re.findall(r"^(?:ENTRYPOINT|CMD|HEALTHCHECK .*CMD) (.+)$", DOCKERFILE, re.MULTILINE)
    assert len(started) == 3
    assert all(isinstance(json.loads(command), list) for command in started)
    assert re.findall(r"^USER (.+)$", DOCKERFILE, re.MULTILINE) == ["10001:10001"]


def test_bytecode_is_of_what_is_loaded_alone():
    """pip takes PIP_NO_COMPILE=1 for a wish to compile: all bytecode was 138 MB, what is loaded is 40."""
    installs = re.findall(r"pip --python /opt/venv install ([^&\n]+)", DOCKERFILE)
    assert len(installs) == 3
    assert all("--no-compile" in install for install in installs)


def make_kernels(folder: Path, version: str) -> Path:
    folder.mkdir()
    (folder / "made-from").write_text(version)
    (folder / "kernel.nbc").write_text(version)
    return folder


def test_kernels_come_onto_the_volume_once_and_again_with_another_image(tmp_path: Path):
    place, volume = loaded("entrypoint").place_kernels, tmp_path / "volume"
    first = make_kernels(tmp_path / "first", "1")
    place(first, volume)
    (volume / "own.nbc").write_text("compiled here")
    place(first, volume)
    assert {file.name for file in volume.iterdir()} == {"made-from", "kernel.nbc", "own.nbc"}
    place(make_kernels(tmp_path / "second", "2"), volume)
    assert {file.name: file.read_text() for file in volume.iterdir()} == {"made-from": "2", "kernel.nbc": "2"}
    assert {path.name for path in tmp_path.iterdir()} == {"first", "second", "volume"}


def test_containers_that_start_at_once_leave_one_whole_copy(tmp_path: Path):
    image, volume = make_kernels(tmp_path / "image", "1"), tmp_path / "volume"
    program = f"import sys; sys.path.insert(0, {str(DEPLOY)!r}); import entrypoint, pathlib;" + (
        f"entrypoint.place_kernels(pathlib.Path({str(image)!r}), pathlib.Path({str(volume)!r}))"
    )
    started = [subprocess.Popen([sys.executable, "-Bc", program]) for _ in range(6)]
    assert [process.wait() for process in started] == [0] * 6
    assert {file.name for file in volume.iterdir()} == {"made-from", "kernel.nbc"}
    assert {path.name for path in tmp_path.iterdir()} == {"image", "volume"}


def test_the_command_takes_the_place_of_the_program_that_starts_it():
    command = [sys.executable, "-I", str(DEPLOY / "entrypoint.py"), sys.executable, "-c", "print('here')"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "here\n"


@pytest.mark.slow
def test_a_library_without_what_nobody_uses_is_smaller_and_works(tmp_path: Path):
    packages = tmp_path / "lib/python3.11/site-packages"
    installed = Path(np.__file__).parent
    for folder in (installed, installed.with_name("numpy.libs")):
        if folder.exists():
            shutil.copytree(folder, packages / folder.name)
    header = packages / "triton/backends/nvidia/include/cuda.h"
    header.parent.mkdir(parents=True)
    header.write_text("needed")
    slim = loaded("slim")
    before = slim.size(packages)
    freed = slim.slim(packages)
    assert freed["tests"] > 5e6
    assert freed["C headers"] > 1e5
    assert slim.size(packages) == before - sum(freed.values())
    assert not list(packages.rglob("tests"))
    assert header.exists()
    program = (
        "import numpy as np; print(np.__file__, np.linalg.inv(2.0 * np.eye(3))[0, 0], np.random.rand() > 0)"
    )
    said = subprocess.run(
        [sys.executable, "-Sc", program],
        env={"PYTHONPATH": str(packages)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.split() == [str(packages / "numpy/__init__.py"), "0.5", "True"]

"""A format that another package adds: declared, listed, read and written like ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from tests.data.scenes import write_image

ROOT = Path(__file__).resolve().parents[2]
MODULE = """
from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.pose_rows import parsed_rows, pose_by
from biresnerf.data.model.untrusted_file import finite_numbers, read_text
from biresnerf.options.formats import Format

RIG_LOG = Format(
    name="rig-log",
    title="a laboratory's log",
    rank=1000,
    found_as=("rig.log",),
    suffixes=(".log",),
    gives="poses",
    checked_against="its test",
    axes="opengl",
    in_set="rig.log",
    loses=("lenses", "rigs", "points", "mask paths"),
    heading="For the laboratory",
    hint="A pose a line",
)


def parse(_root, file):
    lines = [line.split() for line in read_text(file).splitlines()]
    rows = [(words[0], f"{file.name} line {at}", words[1:]) for at, words in enumerate(lines, 1)]

    def read(words, where):
        return pose_by(RIG_LOG, finite_numbers(words, where, "Write 12 numbers.", 12).reshape(3, 4), where), None

    return parsed_rows(RIG_LOG, [file], rows, read)


def write(refined, path, context):
    opengl = refined.world_from_cam * [1, -1, -1, 1]
    lines = [
        " ".join([image.file_name.removeprefix("images/"), *map(repr, pose[:3].ravel().tolist())])
        for image, pose in zip(refined.images, opengl)
    ]
    path.write_text("\\n".join(lines))


CODECS = (Codec(RIG_LOG, parse=parse, write=write),)
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder on the path in which the package lies as pip installs it."""
    folder = tmp_path / "site"
    (folder / "rig_log-1.0.dist-info").mkdir(parents=True)
    (folder / "rig_log-1.0.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: rig-log\nVersion: 1.0\n"
    )
    (folder / "rig_log-1.0.dist-info/entry_points.txt").write_text(
        "[biresnerf.formats]\nrig-log = rig_log.log\n"
    )
    (folder / "rig_log").mkdir()
    (folder / "rig_log/__init__.py").write_text("")
    (folder / "rig_log/log.py").write_text(MODULE)
    return folder


def biresnerf(site: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "biresnerf.command_line", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{site}"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_format_of_another_package_is_written_and_read_and_a_bad_line_is_named(tmp_path, site):
    given = tmp_path / "given"
    poses = {f"{index}.jpg": (index, 2.0 * index, index**2) for index in range(4)}
    for index, name in enumerate(poses):
        write_image(given / name, index)
    table = ["image,x,y,z,qw,qx,qy,qz", *(f"{name},{x},{y},{z},0,1,0,0" for name, (x, y, z) in poses.items())]
    (given / "poses.csv").write_text("\n".join(table))
    written = biresnerf(site, "convert", given, tmp_path / "out", "--to", "rig-log")
    assert written.returncode == 0, written.stderr
    lines = (tmp_path / "out/rig.log").read_text().splitlines()
    # Half a turn about x, as OpenCV has it, is no turn with OpenGL's axes.
    np.testing.assert_allclose(
        [float(word) for word in lines[3].split()[1:]], [1, 0, 0, 3, 0, 1, 0, 6, 0, 0, 1, 9]
    )
    back = biresnerf(site, "convert", tmp_path / "out", tmp_path / "back", "--to", "csv")
    assert back.returncode == 0, back.stderr
    np.testing.assert_allclose(
        read_dataset(tmp_path / "back").world_from_cam, read_dataset(given).world_from_cam, atol=1e-12
    )
    (tmp_path / "out/rig.log").write_text("\n".join([*lines[:3], lines[3] + " 7"]))
    told = biresnerf(site, "inspect", tmp_path / "out", "--json")
    assert (
        "1 of 4 poses cannot be used and are left out: rig.log line 4: has 13 numbers, not 12" in told.stdout
    )


def test_an_entry_point_of_a_module_that_is_not_there_says_so(site):
    (site / "rig_log/log.py").unlink()
    told = biresnerf(site, "formats")
    assert told.returncode != 0
    assert "biresnerf.formats names rig_log.log, which is not there" in told.stderr

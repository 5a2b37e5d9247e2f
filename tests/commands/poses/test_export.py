"""`biresnerf export`: a finished result, read back from its folder, in every other format."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from biresnerf.commands.poses.export import export_command
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.result_formats import read_result, write_result_formats
from biresnerf.errors import InputError
from tests.data.formats.random_sets import random_result
from tests.data.formats.simple.test_pinhole import pack_of
from tests.data.scenes import assert_complete


@pytest.fixture
def result(tmp_path):
    names = [f"i/{k}.jpg" for k in range(5)]
    refined = pack_of(tmp_path / "photos", random_result(1, model="SIMPLE_RADIAL"), names)
    images = {
        number: replace(image, name=name)
        for (number, image), name in zip(refined.model.images.items(), names, strict=True)
    }
    refined = replace(refined, model=replace(refined.model, images=images))
    write_result_formats(refined, tmp_path / "out")
    return refined, tmp_path


def run(*arguments):
    return CliRunner().invoke(export_command, [str(a) for a in arguments], catch_exceptions=True)


def test_a_result_reads_back_as_it_was(result):
    refined, folder = result
    again = read_result(folder / "out")
    assert again.cameras == refined.cameras
    assert [i.name for i in again.images] == [i.name for i in refined.images]
    np.testing.assert_array_equal(again.world_from_cam, refined.world_from_cam)
    np.testing.assert_array_equal(again.model.points.xyz, refined.model.points.xyz)
    assert again.image_ids == refined.image_ids
    assert again.points_source == refined.points_source


def test_forms_are_written_where_they_are_asked_for(result):
    _, folder = result
    done = run(
        folder / "out",
        "pinhole",
        "kitti",
        "colmap-text",
        "--photos",
        folder / "photos",
        "-o",
        folder / "more",
    )
    assert done.exit_code == 0, done.output
    model = read_colmap_model(folder / "more/pinhole/sparse/0")
    assert [image.name for image in model.images.values()] == [f"{k}.jpg" for k in range(5)]
    assert len(list((folder / "more/pinhole/images").iterdir())) == 5
    assert (folder / "more/kitti.txt").is_file()
    assert (folder / "more/colmap/sparse_txt/0/images.txt").is_file()
    assert not (folder / "out/kitti.txt").exists()
    said = run(folder / "out", "kitti", "--json")
    assert json.loads(said.stdout) == {"folder": str(folder / "out"), "formats": ["kitti"], "warnings": []}
    assert (folder / "out/kitti.txt").is_file()


def test_what_is_missing_is_named(result):
    _, folder = result
    for arguments, code, where in (
        ((folder, "kitti"), "result_missing", str(folder)),
        ((folder / "out", "pinhole"), "image_missing", "i/0.jpg"),
        ((folder / "out", "pinhole", "--photos", folder), "image_missing", str(folder)),
    ):
        done = run(*arguments)
        assert isinstance(done.exception, InputError)
        assert_complete(done.exception, code, where)
    path = folder / "out/poses.json"
    document = json.loads(path.read_text())
    document["images"][2]["name"] = document["images"][2]["file_name"] = "else.jpg"
    path.write_text(json.dumps(document))
    done = run(folder / "out", "kitti")
    assert_complete(done.exception, "result_inconsistent", str(folder / "out"))
    assert run(folder / "out", "nothing").exit_code == 2

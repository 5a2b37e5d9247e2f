"""A set that is accepted at the start of a job does not make it fail at the end, whatever its numbers are.

``BIRESNERF_HOSTILE_SETS=500 pytest tests/pipeline/test_hostile_sets.py`` tries that many.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.result_formats import read_result, write_result_formats
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.points.refined_points import with_given_points
from biresnerf.errors import InputError
from biresnerf.options.formats import formats
from biresnerf.pipeline import refine_poses
from tests.data.formats.readers import glb_parts
from tests.pipeline.hostile_sets import EXTREMES, FORMATS, SCALES, change, plain_set
from tests.refinement.tiny_scene import tiny_run

EXPORTS = tuple(name for name, one in formats().items() if one.on_request)
# The shortest run there is, all formats, and no verdict, which would take most of the time.
OPTIONS = tiny_run(
    start="given", verdict=False, steps=20, coarse_steps_max=10, exports=EXPORTS, shown_views=0,
    samples_per_step=1024,
)  # fmt: skip
ASKED = int(os.environ.get("BIRESNERF_HOSTILE_SETS", "0"))
USUAL = settings(deadline=None, derandomize=not ASKED, database=None, suppress_health_check=list(HealthCheck))

PLACES = st.tuples(*[st.integers(0, 999)] * 3)
CHANGES = st.lists(st.tuples(PLACES, st.sampled_from(EXTREMES)), max_size=2)
# Of COLMAP's model more goes into the result than of the other formats.
HOSTILE = (
    st.sampled_from(("colmap-text",) * 4 + FORMATS),
    st.sampled_from((1.0,) * 6 + SCALES),
    st.sampled_from((0.0,) * 8 + (1e6, 9e8)),
    CHANGES,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


def accepted(
    folder: Path, form: str, scale: float, shift: float, changes: list
) -> tuple[Path, Dataset] | None:
    """The set's folder and what is read of it; None where it is refused, or has not all poses."""
    made, work = folder / f"{form} {scale} {shift}", folder / "set"
    shutil.rmtree(work, ignore_errors=True)
    try:
        if not made.exists():
            plain_set(made, form, scale, shift).rename(made / "whole")
        if not (made / "whole").exists():
            return None  # refused before
        shutil.copytree(made / "whole", work)
        change(work, changes)
        dataset = read_dataset(work, within=work)
    except InputError:
        return None
    return (work, dataset) if all(frame.world_from_cam is not None for frame in dataset.frames) else None


def _no_constant(name: str) -> float:
    raise AssertionError(f"a JSON file has {name}")


def assert_whole(result: Path) -> None:
    """Files of strict JSON and of finite numbers, which can be read again."""
    for path in result.rglob("*.json"):
        json.loads(path.read_text(), parse_constant=_no_constant)
    document, binary = glb_parts(result / "scene.glb")
    for accessor in document["accessors"]:
        if accessor["componentType"] == 5126:
            view = document["bufferViews"][accessor["bufferView"]]
            numbers = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"])
            assert np.isfinite(numbers).all()
    read_result(result)


@settings(USUAL, max_examples=20 * ASKED or 20)
@given(*HOSTILE)
def test_what_is_accepted_can_be_written_in_every_format(folder, form, scale, shift, changes):
    found = accepted(folder, form, scale, shift, changes)
    if found is None:
        return
    dataset = found[1]
    refined = refined_set(dataset, dataset.world_from_cam)
    if dataset.source.colmap is not None:
        refined = with_given_points(refined, dataset.source.colmap)
    result = folder / "written"
    shutil.rmtree(result, ignore_errors=True)
    result.mkdir()
    write_result_formats(refined, result, EXPORTS, WriteContext(dataset, None))
    assert_whole(result)


@pytest.mark.slow
@settings(USUAL, max_examples=ASKED or 3)
@given(*HOSTILE)
def test_what_is_accepted_goes_through_a_whole_job(folder, form, scale, shift, changes):
    found = accepted(folder, form, scale, shift, changes)
    if found is None:
        return
    result = folder / "result"
    shutil.rmtree(result, ignore_errors=True)
    refine_poses(found[0], result, OPTIONS)
    assert_whole(result)

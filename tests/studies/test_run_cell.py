"""One cell from start to end, in this process: from identity poses, on a scene without test views."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import Interrupted
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.report import Report
from biresnerf.stages import CHECKPOINT
from biresnerf.studies.cell import CELL, RUN, Cell, Perturbation
from biresnerf.studies.run_cell import matched_error, run_cell
from biresnerf.studies.scenes import find_scene
from tests.geometry.rigs import dome
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow


def test_a_stopped_cell_goes_on_and_is_measured_from_an_identity_start(tmp_path):
    write_synthetic_scene(tmp_path / "scene", 7, 24, seed=3)
    cell = Cell(
        scene=find_scene(tmp_path / "scene", every=1, test_views=25),
        start=Perturbation(kind="identity", noise=0.0),
        options=tiny_run(start="given", holdout=2),
    )
    folder = tmp_path / "cell"
    folder.mkdir()
    (folder / CELL).write_text(cell.model_dump_json())
    asked = iter([False] * 15)
    with pytest.raises(Interrupted):
        run_cell(folder, lambda: next(asked, True))
    assert (folder / RUN / CHECKPOINT).is_file()
    outcome = run_cell(folder, lambda: False).outcome
    assert outcome.resumed == 1
    # One pose for all: each camera is as far from its own as it is turned against the others' mean.
    assert outcome.before.aligned.rotation_deg.mean > 30
    assert outcome.options == cell.options.resolved("cpu")
    report = Report.model_validate_json((folder / RUN / "report.json").read_text())
    assert (outcome.views.kind, outcome.views.count) == ("held out", 2)
    assert outcome.views.psnr == report.heldout.psnr
    assert len(outcome.cameras) == 7
    assert outcome.seconds["test views"] == 0


def test_a_camera_that_matches_did_not_place_is_no_error_of_theirs():
    truth = dome(8, np.random.default_rng(2))
    given = perturb_poses(truth, 0.15, seed=1)
    matched = truth.copy()
    matched[3] = given[3]
    error = matched_error(matched, given, truth)
    assert error.cameras == 7
    assert error.aligned.rotation_deg.max < 1e-6

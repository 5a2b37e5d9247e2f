"""Tables from known results: every figure in its place."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.studies.cell import TEST_VIEWS
from biresnerf.studies.markdown import as_markdown
from biresnerf.studies.tables import make_tables
from tests.studies.outcomes import entry, outcome

ENTRIES = [
    entry(scene, seed, variant, outcome(noise * (1 + offset), seed, psnr, seconds))
    for offset, scene in enumerate(("lego", "ship"))
    for seed in (1, 2)
    for variant, noise, psnr, seconds in (("ours", 0.001 * seed, 30.0, 8.0), ("barf", 0.01, 28.0, 40.0))
]


def tables(entries=ENTRIES):
    return make_tables(entries, {"ours": {}, "barf": {"method": "barf"}}, {"preset": "fast"}, "2 cores")


def row(made, scene, variant):
    return next(r for r in made.rows if (r.scene, r.variant) == (scene, variant))


def test_a_row_is_the_mean_over_seeds_and_the_most_of_maxima():
    found = row(tables(), "ship", "ours")
    runs = [outcome(0.002 * seed, seed).after.aligned for seed in (1, 2)]
    assert found.seeds == (1, 2)
    assert found.values["rotation_deg"] == pytest.approx(np.mean([r.rotation_deg.mean for r in runs]))
    assert found.values["rotation_max_deg"] == max(r.rotation_deg.max for r in runs)
    assert found.values["translation"] == pytest.approx(np.mean([r.translation_table.mean for r in runs]))
    assert found.values["optimisation_s"] == 8
    assert (found.values["coarse_s"], found.values["fine_s"]) == (2, 6)
    assert found.values["not_found"] == 9  # 0.8, 0.9 and 1.0 deg are found, 1.1 and up are not
    assert found.values["lpips"] is None


def test_summaries_are_over_scenes():
    made = tables()
    summary = next(s for s in made.summaries if s.variant == "ours")
    values = [row(made, scene, "ours").values["rotation_deg"] for scene in ("lego", "ship")]
    assert summary.scenes == 2
    assert summary.mean["rotation_deg"] == pytest.approx(np.mean(values))
    assert summary.mean["psnr"] == 30


def test_differences_pair_scenes_and_seeds():
    made = {d.metric: d for d in tables().differences}
    assert made["rotation_deg"].test.pairs == 4
    assert made["rotation_deg"].test.median_difference > 0
    assert made["rotation_deg"].test.p_value == pytest.approx(2 / 16)  # the least that four pairs can give
    assert made["psnr"].test.median_difference == -2
    assert made["ssim"].test.p_value is None  # the same everywhere
    assert "lpips" not in made


def test_a_failed_run_is_told_and_left_out_of_pairs():
    made = tables([*ENTRIES[:-1], entry("ship", 2, "barf", "exit status 1\nTraceback\nValueError: bad")])
    assert row(made, "ship", "barf").seeds == (1,)
    assert row(made, "ship", "barf").failed == 1
    assert {d.test.pairs for d in made.differences} == {3}
    text = as_markdown(made)
    assert "1 (1 failed)" in text
    assert "- ship, noise 0.15, seed 2, barf: exit status 1: ValueError: bad" in text


def test_a_row_has_what_feature_matches_alone_gave_and_the_notes_the_verdict():
    matched = outcome(0.02).after
    made = tables(
        [entry("ship", 1, "ours", outcome(0.01, matched=matched, verdict="improved", chosen="adjusted"))]
    )
    assert row(made, "ship", "ours").values["matched_deg"] == matched.aligned.rotation_deg.mean
    assert row(made, "ship", "ours").values["matched_cameras"] == matched.cameras
    assert "- ship, noise 0.15, seed 1, ours: improved, poses adjusted" in as_markdown(made)


def test_all_seconds_are_those_of_the_run_and_not_of_its_measurement():
    seconds = {"preparing": 5.0, "coarse": 2.0, "fine": 6.0, "judging": 3.0, TEST_VIEWS: 40.0}
    made = tables([entry("ship", 1, "ours", outcome(0.01).model_copy(update={"seconds": seconds}))])
    assert row(made, "ship", "ours").values["total_s"] == 16


def test_markdown_has_every_figure_under_its_title():
    text = as_markdown(tables())
    lines = text.splitlines()
    head = [cell.strip() for cell in lines[2].split("|")]
    ours = next(line for line in lines if line.startswith("| lego | noise 0.15 | ours |"))
    cells = dict(zip(head, [cell.strip() for cell in ours.split("|")], strict=True))
    made = row(tables(), "lego", "ours").values
    assert cells["rotation °"] == f"{made['rotation_deg']:.3f}"
    assert (cells["PSNR"], cells["both s"], cells["switch"], cells["runs"]) == ("30.00", "8.0", "1200", "2")
    assert "LPIPS" not in head
    assert "- no LPIPS: no weights" in text
    assert "| barf | method=barf |" in text
    assert "| rotation ° | barf - ours |" in text
    assert text.endswith("Measured on 2 cores.\n")

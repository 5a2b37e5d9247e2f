"""Plots of known results: the lines drawn are the figures given, named as they are."""

from __future__ import annotations

import json

from biresnerf.data.show.history import HISTORY
from biresnerf.studies.cell import RUN
from biresnerf.studies.plan import Variant
from biresnerf.studies.plots import plot_curves, plot_noise, plot_sweep
from tests.studies.outcomes import entry, outcome

VARIANTS = [Variant(f"L {n}", {"pose_levels": n}) for n in (1, 3, 8)]


def test_a_sweep_has_a_line_for_each_scene_and_the_same_bytes_twice(tmp_path):
    entries = [
        entry(scene, seed, variant.name, outcome(0.01 * variant.settings["pose_levels"], seed))
        for scene in ("lego", "ship")
        for seed in (1, 2)
        for variant in VARIANTS
    ]
    drawn = [
        plot_sweep(entries, VARIANTS, "pose_levels", "levels of the module", tmp_path / name, "levels")
        for name in ("one", "two")
    ]
    svg, png = drawn[0]
    text = svg.read_text()
    for part in ("lego", "ship", "rotation error", "PSNR of unseen views", "levels of the module"):
        assert part in text
    assert png.read_bytes().startswith(b"\x89PNG")
    assert text == drawn[1][0].read_text()


def test_a_noise_sweep_names_variants_and_the_start(tmp_path):
    entries = [entry("lego", 1, "ours", outcome(0.01)), entry("lego", 1, "barf", "exit status 1")]
    text = plot_noise(entries, "noise of the given poses", tmp_path, "noise")[0].read_text()
    for part in ("lego", "start", "ours", "noise of the given poses"):
        assert part in text


def test_curves_are_read_from_the_runs_histories(tmp_path):
    run = entry("lego", 1, "smooth warm-up", outcome(0.01, switch_step=100))
    history = tmp_path / "cells" / run.result.cell.folder_name / RUN / HISTORY
    history.parent.mkdir(parents=True)
    lines = [{"step": s, "psnr": 20 + s / 100, "rotation_deg": 10 / s} for s in range(50, 200, 10)]
    history.write_text("".join(json.dumps(line) + "\n" for line in lines))
    text = plot_curves([run], tmp_path / "cells", tmp_path, "warm-up")[0].read_text()
    assert "smooth warm-up" in text
    assert "dotted: stage 2 begins" in text

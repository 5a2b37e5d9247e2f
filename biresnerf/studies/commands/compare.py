"""`biresnerf compare SCENE...`: methods and options against each other, on poses made wrong by a known amount."""

from __future__ import annotations

from typing import Any

import click

from biresnerf.studies.commands.comparison_options import (
    chosen_variants,
    comparison_options,
    make_plan,
    require,
    run_and_write,
    shared_settings,
)


@click.command("compare")
@comparison_options
def compare_command(**given: Any) -> int:
    """Perturb the true poses of SCENES, refine them with each variant, and measure the results against the truth.

    A scene is a folder with a transforms.json (or transforms_train.json) of true poses. Each run has a process
    of its own; finished ones are kept in OUT/cells, and the same command goes on where it was stopped.
    OUT/tables.md and OUT/tables.json hold errors, image quality, times, memory, and Wilcoxon's test between the
    first variant and each other one. A run that fails is a line in the tables; the exit status is then 1.
    """
    require("scipy")
    plan = make_plan(given, chosen_variants(given), shared_settings(given), given["noise"] or (0.15,))
    entries = run_and_write(plan, given)
    return int(any(entry.result.error is not None for entry in entries))

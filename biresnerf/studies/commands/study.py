"""`biresnerf study NAME SCENE...`: the paper's studies, with plots."""

from __future__ import annotations

from typing import Any

import click

from biresnerf.errors import InputError, needs_extra
from biresnerf.studies.commands.compare import (
    CELLS,
    chosen_variants,
    comparison_options,
    make_plan,
    run_and_write,
    shared_settings,
)

NAMES = ("resolution", "levels", "warm-up", "noise")


@click.command("study")
@click.argument("name", type=click.Choice(NAMES))
@comparison_options
def study_command(name: str, **given: Any) -> int:
    """Repeat a study of the paper on SCENES, as `biresnerf compare` with variants made for it, and plot the results.

    resolution and levels vary the pose-estimation module in stage 1 alone; warm-up shows training PSNR and
    pose error around the switch with and without it; noise varies the error of the given poses for the named
    methods or variants. The plot is OUT/NAME.svg and OUT/NAME.png.
    """
    with needs_extra("studies"):  # before anything runs
        import matplotlib  # noqa: F401
        import scipy  # noqa: F401
    from biresnerf.studies.plots import plot_curves, plot_noise, plot_sweep
    from biresnerf.studies.studies import STUDIES

    study, variants = STUDIES[name], chosen_variants(given)
    if variants and study.variants:
        raise InputError(
            "invalid_options",
            f"the study {name} has its own variants.",
            where="--variant",
            hint="Leave them out, or use `biresnerf compare`.",
        )
    variants = variants or study.variants
    plan = make_plan(given, variants, study.settings(shared_settings(given)), given["noise"] or study.noises)
    entries = run_and_write(plan, given)
    output = given["output"]
    if study.swept is not None:
        paths = plot_sweep(entries, variants, study.swept, study.about, output, name)
    elif name == "noise":
        paths = plot_noise(entries, study.about, output, name)
    else:
        paths = plot_curves(entries, output / CELLS, output, name)
    click.echo("\n".join(str(path) for path in paths), err=True)
    return int(any(entry.result.error is not None for entry in entries))

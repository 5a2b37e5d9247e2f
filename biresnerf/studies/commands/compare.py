"""`biresnerf compare SCENE...`: methods and options against each other, on poses perturbed by a known amount.

Also the options and functions that `biresnerf study` shares.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.answers import json_option, print_json
from biresnerf.commands.machine.this_machine import describe_machine
from biresnerf.commands.settings_option import parse_settings, settings_option
from biresnerf.errors import InputError, needs_extra
from biresnerf.options.presets import PRESET_IF_LEFT_OUT, PRESETS

if TYPE_CHECKING:
    from biresnerf.studies.plan import Entry, Plan, Variant

TABLES_MARKDOWN, TABLES_JSON, CELLS = "tables.md", "tables.json", "cells"


def _numbers(kind: Callable[[str], Any]) -> Callable[..., Any]:
    def read(
        _context: click.Context, _parameter: click.Parameter, text: str | None
    ) -> tuple[Any, ...] | None:
        if text is None:
            return None
        try:
            return tuple(dict.fromkeys(kind(part) for part in text.split(",")))
        except ValueError:
            raise click.BadParameter(f"{text!r} is no list of numbers like 1,2,3") from None

    return read


def comparison_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a click command the options of a comparison."""
    options: list[Callable[..., Any]] = [
        click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path)),
        click.option(
            "--output", "-o", required=True, type=click.Path(path_type=Path),
            help="Folder for cells and tables; finished cells are not run again.",
        ),
        click.option(
            "--preset",
            type=click.Choice(list(PRESETS)),
            help=f"Of all variants. Default: {PRESET_IF_LEFT_OUT}.",
        ),
        settings_option,
        click.option("--size", type=click.IntRange(16, 4096), help="Long side (px): max_image_size of all variants."),
        click.option("--methods", metavar="A,B", help="Variants that differ in the option `method`."),
        click.option(
            "--variant", "variants", multiple=True, metavar="'NAME: KEY=VALUE ...'",
            help="A variant of the options, by name; may be repeated. The first one is what others are tested against. "
            "method.FIELD=VALUE changes a field of the method, as method.repair=false.",
        ),
        click.option("--noise", callback=_numbers(float), metavar="A,B", help="BARF's sigma. Default: 0.15."),
        click.option(
            "--seeds", callback=_numbers(int), default="1", show_default=True, metavar="1,2,3",
            help="Of noise and run alike.",
        ),
        click.option("--every", type=click.IntRange(1), default=1, metavar="K", help="Use each K-th view."),
        click.option(
            "--start", type=click.Choice(["noise", "identity"]), default="noise", show_default=True,
            help="identity: all cameras start at one pose, as BARF's forward-facing sets do.",
        ),
        click.option("--turn-one", type=float, default=0.0, metavar="DEG", help="Turn one camera in place as well."),
        click.option(
            "--lose", type=click.FloatRange(0, 1), default=0.0, metavar="SHARE",
            help="Turn this share of the cameras about the scene by 45 to 180 degrees as well.",
        ),
        click.option("--equal-time", is_flag=True, help="Give all variants the first one's optimisation time."),
        click.option(
            "--test-views", type=click.IntRange(0), default=25, show_default=True,
            help="Score at most so many views of transforms_test.json, where there is one.",
        ),
        click.option("--retry-failed", is_flag=True, help="Run recorded failures again."),
        json_option,
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def shared_settings(given: dict[str, Any]) -> dict[str, Any]:
    """Refinement options of all variants, from the command line."""
    named = {"preset": given["preset"], "max_image_size": given["size"]}
    return given["settings"] | {key: value for key, value in named.items() if value is not None}


def chosen_variants(given: dict[str, Any]) -> tuple[Variant, ...]:
    """Variants of `--methods`, then of `--variant`. Raises `InputError` for missing or duplicate names."""
    from biresnerf.studies.plan import Variant

    methods = given["methods"].split(",") if given["methods"] else []
    variants = [Variant(name, {"method": name}) for name in methods]
    for text in given["variants"]:
        name, separator, settings = text.partition(":")
        if not separator or not name.strip():
            raise InputError(
                "invalid_options",
                f"{text!r} is not 'NAME: KEY=VALUE ...'.",
                where="--variant",
                hint="Give a name, a colon and options.",
            )
        variants.append(Variant(name.strip(), parse_settings(tuple(settings.split()))))
    names = [variant.name for variant in variants]
    if len(set(names)) < len(names):
        raise InputError(
            "invalid_options",
            "two variants have the same name.",
            where="--variant",
            hint="Name them differently.",
        )
    return tuple(variants)


def make_plan(
    given: dict[str, Any], variants: Sequence[Variant], settings: dict[str, Any], noises: Sequence[float]
) -> Plan:
    """The plan of a command line; scenes and options are validated before anything runs."""
    from biresnerf.studies.cell import Perturbation
    from biresnerf.studies.plan import Plan, Variant
    from biresnerf.studies.scenes import find_scene

    scenes = tuple(find_scene(path, given["every"], given["test_views"]) for path in given["scenes"])
    if len({scene.name for scene in scenes}) < len(scenes):
        raise InputError(
            "invalid_options", "two scenes have the same name.", where="SCENES", hint="Rename one's folder."
        )
    starts = tuple(
        Perturbation(
            kind=given["start"],
            noise=0.0 if given["start"] == "identity" else noise,
            seed=seed,
            turn_one_deg=given["turn_one"],
            lose_share=given["lose"],
        )
        for noise, seed in product(noises, given["seeds"])
    )
    chosen = tuple(variants) or (Variant("default", {}),)
    plan = Plan(scenes, starts, chosen, settings, given["equal_time"])
    for scene, start, variant in product(scenes, starts, chosen):
        plan.options(variant, scene, start)
    return plan


def run_and_write(plan: Plan, given: dict[str, Any]) -> list[Entry]:
    """Run unfinished cells, write tables.md and tables.json, and print one of them."""
    from biresnerf.data.model.atomic_file import write_text
    from biresnerf.studies.markdown import as_markdown
    from biresnerf.studies.plan import Runner, run_plan
    from biresnerf.studies.tables import make_tables

    signal.signal(signal.SIGTERM, _end)
    output: Path = given["output"]
    entries = run_plan(
        plan, Runner(output / CELLS, lambda text: click.echo(text, err=True), given["retry_failed"])
    )
    variants = {variant.name: variant.settings for variant in plan.variants}
    tables = make_tables(entries, variants, plan.settings, describe_machine())
    markdown = as_markdown(tables)
    write_text(output / TABLES_JSON, tables.model_dump_json(indent=1))
    write_text(output / TABLES_MARKDOWN, markdown.rstrip())
    if given["as_json"]:
        print_json(tables)
    else:
        click.echo(markdown)
    return entries


def _end(number: int, _frame: FrameType | None) -> None:
    sys.exit(128 + number)


@click.command("compare")
@comparison_options
def compare_command(**given: Any) -> int:
    """Perturb the true poses of SCENES, refine them with each variant, and measure the results against the truth.

    A scene is a folder with a transforms.json (or transforms_train.json) of true poses. Each run has its own
    process; finished ones are kept in OUT/cells, and the same command resumes after a stop.
    OUT/tables.md and OUT/tables.json hold errors, image quality, times, memory, and Wilcoxon's test between the
    first variant and each other one. A failed run is a line in the tables; the exit status is then 1.
    """
    with needs_extra("studies"):
        import scipy  # noqa: F401 - before anything runs
    plan = make_plan(given, chosen_variants(given), shared_settings(given), given["noise"] or (0.15,))
    entries = run_and_write(plan, given)
    return int(any(entry.result.error is not None for entry in entries))

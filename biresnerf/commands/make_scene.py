"""`biresnerf make-scene OUT`: a scene whose true poses are known, with noise on the poses it gives."""

from __future__ import annotations

import shutil
from pathlib import Path

import click

from biresnerf.errors import InputError


@click.command("make-scene")
@click.argument("output", type=click.Path(path_type=Path))
@click.option("--views", type=click.IntRange(3, 400), default=60, show_default=True, help="Images.")
@click.option("--size", type=click.IntRange(16, 800), default=100, show_default=True, help="Their width, px.")
@click.option("--noise", type=click.FloatRange(0, 1), default=0.15, show_default=True, help="BARF's sigma.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
def make_scene_command(output: Path, views: int, size: int, noise: float, seed: int) -> None:
    """Write images and a transforms.json with perturbed poses to OUTPUT, and the true poses beside it.

    The true poses are in OUTPUT.truth.json; `biresnerf pose-error` compares a result with them.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(
            "output_not_empty", "is not an empty folder.", where=str(output), mend="Name a new folder."
        )
    from biresnerf.data.synthetic import write_synthetic_scene
    from biresnerf.data.transforms_json import read_transforms
    from biresnerf.data.write import write_transforms
    from biresnerf.geometry.perturb import perturb_poses

    path = write_synthetic_scene(output, views, size, seed)
    truth = output.with_name(f"{output.name}.truth.json")
    shutil.copyfile(path, truth)
    dataset = read_transforms(path)
    write_transforms(dataset, perturb_poses(dataset.world_from_cam, noise, seed), path)
    click.echo(f"{views} views in {output}, true poses in {truth}")

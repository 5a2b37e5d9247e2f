"""`biresnerf evaluate RESULT TRUTH`: how far poses are from those of a reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.answers import print_json
from biresnerf.errors import InputError

if TYPE_CHECKING:
    from biresnerf.geometry.pose_error import FrameError, PoseError, Spread
    from biresnerf.geometry.trajectory_error import TrajectoryError

_ROWS = (
    ("rotation_deg", "rotation (deg)"),
    ("centre_percent", "camera centre (% of distance)"),
    ("translation", "translation t of cam_from_world"),
    ("translation_table", "  the same x100 at distance 4"),
)
_TITLES = {
    "aligned": "aligned",
    "aligned_robust": "robust",
    "own_frame": "own frame",
    "paper_compat": "paper compat",
}


@click.command("evaluate")
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of a table.")
@click.option("--paper-compat", is_flag=True, help="Add the alignment of BARF's and BAA-NGP's code.")
def evaluate_command(result: Path, truth: Path, as_json: bool, paper_compat: bool) -> None:
    """Measure the poses of RESULT against those of TRUTH.

    Both are files with poses, or folders that hold one, in any form that `refine` reads. Images are matched by name,
    with or without extension, else by file name alone where just one has it; they need not be there. "aligned" is after
    BARF's similarity of the camera centres, as published tables have it: the least-squares rotation, and the ratio of
    the rigs' sizes for scale; "robust" after one that single lost cameras do not drag along; "own frame" without any
    alignment. --paper-compat adds the alignment of the published code with its flaw on flat rigs. ATE and RPE (from
    each image to the next, in RESULT's order) are after the least-squares similarity (Umeyama's); AUC is of the
    relative poses of all pairs, and needs none. docs/conventions.md defines them all.
    """
    import numpy as np

    from biresnerf.data.formats.read_dataset import read_poses
    from biresnerf.geometry.pose_error import paper_compat_error, pose_error
    from biresnerf.geometry.trajectory_error import trajectory_error

    estimated, true = read_poses(result), read_poses(truth)
    pairs = matched_names(list(estimated), list(true))
    if not pairs:
        raise InputError(
            "no_common_images",
            f"no image with a pose in both files ({len(estimated)} there, {len(true)} in {truth}).",
            where=str(result),
            hint="Compare files of the same images; file_path decides.",
        )
    both = np.stack([estimated[name] for name, _ in pairs]), np.stack([true[name] for _, name in pairs])
    error, further = pose_error(*both), trajectory_error(*both)
    frames = {"aligned": error.aligned, "aligned_robust": error.aligned_robust, "own_frame": error.own_frame}
    if paper_compat:
        frames["paper_compat"] = paper_compat_error(*both)
    left_out = {"result": len(estimated) - len(pairs), "truth": len(true) - len(pairs)}
    by_file_name = sum(_bare(name) != _bare(other) for name, other in pairs)
    names = [name for name, _ in pairs]
    if as_json:
        named = _as_json(error, frames, names, left_out)
        print_json({**named, **further.model_dump(), "matched_by_file_name": by_file_name})
        return
    click.echo(_as_table(error, frames, names, left_out))
    click.echo("\n" + _further_lines(further))
    if by_file_name:
        click.echo(f"\n{by_file_name} images were matched by file name alone, from folders of other names")


def matched_names(estimated: list[str], true: list[str]) -> list[tuple[str, str]]:
    """Pairs (name in the estimate, name in the truth) of the same image, in the order of the estimate.

    Equal names match; else names that differ in the image's extension only, where one file alone has each; else names
    of which just the last part is the same, by the same rule.
    """
    exact = set(true)
    partner = {name: name for name in estimated if name in exact}
    for key in (_bare, _bare_file_name):
        theirs, ours = _grouped(true, key), _grouped(estimated, key)
        taken = set(partner.values())
        for name in estimated:
            candidates = theirs.get(key(name), [])
            if (
                name not in partner
                and len(candidates) == len(ours[key(name)]) == 1
                and candidates[0] not in taken
            ):
                partner[name] = candidates[0]
    return [(name, partner[name]) for name in estimated if name in partner]


def _grouped(names: list[str], key: Callable[[str], str]) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(key(name), []).append(name)
    return grouped


def _bare_file_name(name: str) -> str:
    return Path(_bare(name)).name


def _bare(name: str) -> str:
    from biresnerf.data.photos.image_files import is_image_name

    return str(Path(name).with_suffix("")) if is_image_name(Path(name)) else name


def _as_json(
    error: PoseError, frames: dict[str, FrameError], names: list[str], left_out: dict[str, int]
) -> dict[str, Any]:
    named = {key: {**frame.model_dump(), "worst": names[frame.worst]} for key, frame in frames.items()}
    return {**error.model_dump(), **named, "left_out": left_out}


def _as_table(
    error: PoseError, frames: dict[str, FrameError], names: list[str], left_out: dict[str, int]
) -> str:
    lines = [f"{error.cameras} cameras; distance {error.reference_distance:.6g} ({error.reference})"]
    if any(left_out.values()):
        lines.append(
            f"left out: {left_out['result']} only in the result, {left_out['truth']} only in the truth"
        )
    for key, frame in frames.items():
        title = _TITLES[key]
        lines.append(f"\n{title:<34}{'mean':>12}{'median':>12}{'max':>12}   worst {names[frame.worst]}")
        for key, label in _ROWS:
            spread: Spread = getattr(frame, key)
            lines.append(f"  {label:<32}{spread.mean:>12.5g}{spread.median:>12.5g}{spread.max:>12.5g}")
    return "\n".join(lines)


def _further_lines(error: TrajectoryError) -> str:
    lines = [f"ATE {error.ate_rmse:.5g} (RMSE, in the truth's units)"]
    if error.rpe_translation_rmse is not None:
        turned = error.rpe_rotation_deg_rmse
        lines.append(
            f"RPE {error.rpe_translation_rmse:.5g}, {turned:.5g} deg (RMSE, from each image to the next)"
        )
    if error.auc:
        areas = "  ".join(f"@{limit} {100 * area:.1f} %" for limit, area in error.auc.items())
        lines.append(f"AUC of relative poses {areas} (degrees)")
    return "\n".join(lines)

"""`biresnerf evaluate RESULT TRUTH`: how far poses are from those of a reference, and how far they were before."""

from __future__ import annotations

import posixpath
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from biresnerf.commands.answers import print_json
from biresnerf.errors import InputError

if TYPE_CHECKING:
    from biresnerf.arrays import Array
    from biresnerf.commands.poses.error_table import Measured

SHARED_POINTS = 5  # that two photos have in common if they share a view, as in COLMAP's benchmark


@click.command("evaluate")
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--before",
    "before_path",
    type=click.Path(path_type=Path),
    help="Poses to compare with. Default: those that were given, where RESULT is a folder that `refine` wrote.",
)
@click.option(
    "--plot", "-o", type=click.Path(path_type=Path),
    help="Also draw the errors of each image into this file (.png, .svg, .pdf).",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of a table.")
@click.option("--paper-compat", is_flag=True, help="Add the alignment of BARF's and BAA-NGP's code.")
def evaluate_command(
    result: Path, truth: Path, before_path: Path | None, plot: Path | None, as_json: bool, paper_compat: bool
) -> None:
    """Measure the poses of RESULT against those of TRUTH, beside the poses before.

    RESULT and TRUTH are files with poses, or folders that hold one, in any form that `refine` reads. Images are matched
    by name, with or without extension, or else by file name alone; they need not be there. Errors are "aligned" by
    BARF's similarity of the camera centres, as in published tables; "robust", by one that single lost cameras do not
    affect; and in the "own frame" without any, which includes where the whole rig lies. docs/conventions.md defines
    them, ATE, RPE and AUC.
    """
    from biresnerf.commands.poses.error_table import error_table
    from biresnerf.commands.poses.plot_errors import refuse_other_files
    from biresnerf.data.formats.read_dataset import read_poses, seen_points

    if plot is not None:
        refuse_other_files(plot)
    estimated, true, points = read_poses(result), read_poses(truth), seen_points(truth)
    pairs = matched_names(list(estimated), list(true))
    if not pairs:
        raise InputError(
            "no_common_images",
            f"no image with a pose in both files ({len(estimated)} there, {len(true)} in {truth}).",
            where=str(result),
            hint="Compare files of the same images; file_path decides.",
        )
    before = _given_poses(result) if before_path is None else read_poses(before_path)
    had = dict(matched_names([name for name, _ in pairs], list(before)))
    after = _measure(estimated, true, points, pairs, paper_compat)
    earlier = None
    if had:
        of_before = [(had[name], other) for name, other in pairs if name in had]
        earlier = _measure(before, true, points, of_before, paper_compat)
    if plot is not None:
        _plot(plot, {name: before[had[name]] for name in had}, estimated, true, pairs, after)
    left_out = {"result": len(estimated) - len(pairs), "truth": len(true) - len(pairs)}
    by_file_name = sum(_bare(name) != _bare(other) for name, other in pairs)
    if as_json:
        print_json(
            {
                **after.as_json(),
                "before": None if earlier is None else earlier.as_json(),
                "left_out": left_out,
                "matched_by_file_name": by_file_name,
            }
        )
        return
    click.echo(error_table(after, earlier, left_out))
    if by_file_name:
        click.echo(f"\n{by_file_name} images were matched by file name alone, from folders of other names")
    if plot is not None:
        click.echo(f"\nplot: {plot}")


def _given_poses(result: Path) -> dict[str, Array]:
    """The poses by name that a result of `refine` began with; none of anything else."""
    from biresnerf.data.formats.simple.poses_json import POSES, matrix_of, read_poses_json

    if not (result / POSES).is_file():
        return {}
    return {
        posixpath.normpath(image.name): matrix_of(image.world_from_cam_before)
        for image in read_poses_json(result / POSES).images
        if image.world_from_cam_before is not None
    }


def _measure(
    poses: dict[str, Array],
    true: dict[str, Array],
    points: dict[str, set[int]],
    pairs: list[tuple[str, str]],
    paper_compat: bool,
) -> Measured:
    import numpy as np

    from biresnerf.commands.poses.error_table import Measured
    from biresnerf.geometry.pose_error import paper_compat_error, pose_error
    from biresnerf.geometry.trajectory_error import trajectory_error

    both = np.stack([poses[name] for name, _ in pairs]), np.stack([true[name] for _, name in pairs])
    error = pose_error(*both)
    frames = {
        "aligned_robust": error.aligned_robust,
        "aligned": error.aligned,
        "own_frame": error.own_frame,
    }
    if paper_compat:
        frames["paper_compat"] = paper_compat_error(*both)
    seen = [points.get(name, set()) for _, name in pairs]
    covisible = np.array([[len(a & b) >= SHARED_POINTS for b in seen] for a in seen])
    further = trajectory_error(*both, len(true) - len(pairs), covisible)
    return Measured([name for name, _ in pairs], error, frames, further)


def _plot(
    path: Path,
    before: dict[str, Array],
    estimated: dict[str, Array],
    true: dict[str, Array],
    pairs: list[tuple[str, str]],
    after: Measured,
) -> None:
    """Draws the errors after robust alignment, of each set by itself."""
    import numpy as np

    from biresnerf.commands.poses.plot_errors import plot_errors
    from biresnerf.geometry.pose_error import CameraErrors, camera_errors
    from biresnerf.geometry.similarity import align_robust

    truth = np.stack([true[other] for _, other in pairs])
    sets = {}
    for label, poses in (("before", before), ("after", estimated)):
        known = np.array([name in poses for name, _ in pairs])
        if not known.any():
            continue
        stack = np.stack([poses[name] for name, _ in pairs if name in poses])
        found = camera_errors(align_robust(stack, truth[known]).apply_to_poses(stack), truth[known])
        columns = np.full((3, len(pairs)), np.nan)
        columns[:, known] = found.rotation_deg, found.translation, found.centre
        sets[label] = CameraErrors(*columns)
    plot_errors(path, sets, after.error.reference_distance, f"{len(pairs)} images against the true poses")


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

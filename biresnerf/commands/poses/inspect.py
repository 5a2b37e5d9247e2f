"""`biresnerf inspect INPUT`: what a folder contains, and what `refine` would do with it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.answers import json_option, show
from biresnerf.commands.settings_option import settings_option
from biresnerf.errors import InputError
from biresnerf.options.presets import PRESET_IF_LEFT_OUT, PRESETS, PresetName
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions, parse_options

if TYPE_CHECKING:
    from biresnerf.data.model.dataset import Dataset


@click.command("inspect")
@click.argument("input_path", metavar="INPUT", type=click.Path(path_type=Path))
@click.option(
    "--preset",
    type=click.Choice(list(PRESETS)),
    help=f"The preset that `refine` would use. Default: {PRESET_IF_LEFT_OUT}.",
)
@settings_option
@click.option("--pixels", is_flag=True, help="Also decode every image, to find damaged ones.")
@json_option
def inspect_command(
    input_path: Path, preset: str | None, settings: dict[str, Any], pixels: bool, as_json: bool
) -> None:
    """Show what INPUT contains and what `refine` would do with it.

    Checks all that `refine` checks before it starts. Pixels are only checked with --pixels.
    """
    from tqdm import tqdm

    asked = parse_options({**settings, **({"preset": preset} if preset else {})})
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.given_poses.readings import read_as
    from biresnerf.data.model.part_of_set import without_photos
    from biresnerf.data.photos.alike.copied_photos import without_copies
    from biresnerf.data.photos.alike.turning_object import turning_notes
    from biresnerf.data.photos.images import load_images
    from biresnerf.data.photos.panoramas.cut_panoramas import called_panoramas
    from biresnerf.data.photos.video.video_frames import VideoReading

    dataset = read_dataset(input_path, videos=VideoReading(asked.video_frames))
    # Loads torch; faults of the input have been reported by now.
    from biresnerf.field.backends import resolve_here

    options, _ = resolve_here(asked)
    missing_names = sorted(name for name in set(options.fixed) if not dataset.called(name))
    dataset = without_copies(without_photos(dataset, options.leave_out, options.photos))
    dataset = read_as(dataset, options.given_poses)
    if options.panoramas == "all":
        dataset = called_panoramas(dataset)
    if pixels:
        with tqdm(total=len(dataset), desc="decoding", unit="photo", leave=False, disable=None) as bar:
            load_images(dataset, options.max_image_size, options.background, lambda _done: bar.update())
    wanted = {**plan(dataset, options), "seconds": expected_seconds(dataset, asked)}
    found = {**contents(dataset), "pixels_checked": pixels, "plan": wanted}
    found["pose_question"] = None if options.given_poses else question_about(dataset)
    found["warnings"] += turning_notes(dataset)
    found["warnings"] += [f"fixed names no image: {name}" for name in missing_names]
    show(found, "\n".join(_lines(found)), as_json=as_json)


def contents(dataset: Dataset) -> dict[str, Any]:
    """What the set contains, as JSON values."""
    taken = Counter(frame.camera for frame in dataset.frames)
    return {
        "folder": str(dataset.root),
        "format": dataset.source.dialect,
        "pose_files": [str(file) for file in dataset.source.files],
        "images": len(dataset),
        "with_pose": int(dataset.posed.sum()),
        "without_pose": [f.name for f in dataset.frames if f.world_from_cam is None],
        "masks": sum(frame.mask is not None for frame in dataset.frames),
        "cameras": [
            {
                "model": camera.model,
                "width": camera.width,
                "height": camera.height,
                "params": camera.params,
                "intrinsics": dataset.source_of_intrinsics(index),
                "images": taken[index],
            }
            for index, camera in enumerate(dataset.cameras)
        ],
        "warnings": list(dataset.warnings),
    }


def question_about(dataset: Dataset) -> dict[str, Any] | None:
    """What to ask about the given poses, as JSON values; nothing where a photo cannot be decoded: see --pixels."""
    from biresnerf.data.given_poses.likely_reading import pose_question

    try:
        question = pose_question(dataset)
    except InputError:
        return None
    return question.model_dump(mode="json") if question else None


def plan(dataset: Dataset, options: ResolvedOptions) -> dict[str, Any]:
    """What `refine` would do with these options."""
    from biresnerf.data.photos.images import working_size
    from biresnerf.data.photos.panoramas.cut_panoramas import as_views

    views = as_views(dataset)
    sizes = [
        working_size(camera.width, camera.height, options.max_image_size)
        for camera in map(views.camera_of, range(len(views)))
    ]
    return {
        "views": len(views),
        "preset": options.preset,
        "start": start_in_words(dataset, options),
        "steps": options.steps,
        "working_size": max(sizes),
        "photo_bytes": sum(3 * width * height for width, height in sizes),
    }


def expected_seconds(dataset: Dataset, asked: RefineOptions) -> dict[PresetName, tuple[float, float]]:
    """The least and the most seconds that a run with each preset would take here, by what earlier runs measured.

    Empty where one of the first photos, which show whether there is a background, cannot be decoded.
    """
    from biresnerf.field.backends import resolve_here
    from biresnerf.forecast.rates import machine_rates
    from biresnerf.forecast.run_forecast import Forecast
    from biresnerf.machine import usable_cores
    from biresnerf.refinement.finish.work_ahead import expect_run
    from biresnerf.refinement.optimise.methods import Recipe

    found: dict[PresetName, tuple[float, float]] = {}
    for preset in PRESETS:
        options, device = resolve_here(asked.model_copy(update={"preset": preset}))
        threads, forecast = options.threads or usable_cores(), Forecast()
        try:
            expect_run(forecast, dataset, asked, Recipe.of(options, device, threads))
        except InputError:  # --pixels says of which photo
            return {}
        found[preset] = machine_rates(device.type, threads).between(forecast.left)
    return found


def start_in_words(dataset: Dataset, options: ResolvedOptions) -> str:
    """Where the initial poses would come from."""
    from biresnerf.data.seeding.match_poses import can_match

    start, missing = options.start, int((~dataset.posed).sum())
    none, all_given = missing == len(dataset), missing == 0
    if start == "given":
        if all_given:
            return "the given poses, as they are"
        return f"refused: start=given, and {missing} images have no pose"
    if start == "none":
        return (
            "the given poses"
            if all_given
            else f"{missing} poses are guessed from other images, without features"
        )
    if start == "turntable":
        return "cameras on a ring in the order of the images' names, whatever is given"
    if not can_match():
        if start == "colmap" or none:
            return "refused: the poses have to be found, and COLMAP is not installed (pip install 'biresnerf[colmap]')"
        guessed = f"; {missing} are guessed from other images" if missing else ""
        return (
            f"the given poses, without comparing them with feature matches: COLMAP is not installed{guessed}"
        )
    if start == "colmap":
        return "COLMAP's poses, whatever is given"
    if none:
        return "COLMAP finds the poses of all images, in a frame and scale of its own"
    found = f"; feature matches find the {missing} missing ones in their frame" if missing else ""
    return f"the given poses, or what feature matches make of them where that predicts unseen views better{found}"


def in_minutes(least_s: float, most_s: float) -> str:
    """A predicted time, rounded to its precision."""
    least, most = _amount_and_unit(least_s), _amount_and_unit(most_s)
    if least == most:
        return " ".join(most)
    return (
        f"{least[0]} to {' '.join(most)}" if least[1] == most[1] else f"{' '.join(least)} to {' '.join(most)}"
    )


def _amount_and_unit(seconds: float) -> tuple[str, str]:
    if seconds < 55:
        return f"{max(5, 5 * round(seconds / 5))}", "s"
    minutes = seconds / 60
    return (f"{minutes:.0f}", "min") if minutes < 90 else (f"{minutes / 60:.1f}", "h")


def _posed(posed: int, without: list[str]) -> str:
    """How many photos have a pose, and a few that have none."""
    from biresnerf.data.photos.photo_folders import few_names

    if not without:
        return f"{posed} with a pose"
    return (
        f"{posed} with a pose, {len(without)} without: {few_names(without, 3)}"
        if posed
        else "none with a pose"
    )


def _learned_from(found: dict[str, Any]) -> str:
    """At what size the field sees the photos, beside their own."""
    own = max((camera["width"], camera["height"]) for camera in found["cameras"])
    width, height = found["plan"]["working_size"]
    memory = f"{found['plan']['photo_bytes'] / 2**20:.0f} MiB in memory"
    if (width, height) == own:
        return f"learn from the photos at their own size ({memory})"
    return (
        f"learn from copies shrunk to {width} x {height} px ({memory}); photos and results keep the full size"
    )


def _lines(found: dict[str, Any]) -> list[str]:
    lines = [f"{found['folder']}: {found['images']} images, {found['format']}"]
    lines += [f"  poses from {file}" for file in found["pose_files"][:5]]
    lines.append(f"  {_posed(found['with_pose'], found['without_pose'])}")
    for camera in found["cameras"]:
        size = f"{camera['width']} x {camera['height']} px"
        lines.append(
            f"  {camera['images']} images of {size} by {camera['model']}, intrinsics {camera['intrinsics']}"
        )
    if found["masks"]:
        lines.append(f"  {found['masks']} masks")
    wanted = found["plan"]
    lines += [
        f"refine --preset {wanted['preset']} would",
        f"  start from: {wanted['start']}",
        *([f"  cut panoramas: {wanted['views']} views"] if wanted["views"] > found["images"] else []),
        f"  take {wanted['steps']} steps",
        f"  {_learned_from(found)}",
    ]
    if wanted["seconds"]:
        times = (f"{in_minutes(*between)} ({preset})" for preset, between in wanted["seconds"].items())
        lines.append("  take about " + ", ".join(times))
    lines += [f"warning: {warning}" for warning in found["warnings"]]
    if asked := found["pose_question"]:
        lines += [
            f"question: {asked['question']}",
            f"  If so: --set given_poses={','.join(asked['given_poses'])}",
        ]
    return lines

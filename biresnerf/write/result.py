"""The result of a run: poses in all requested formats, pictures, view.json, and the report."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.positions.known_distance import KnownDistance
from biresnerf.data.formats.result_formats import write_body_beside, write_result_formats
from biresnerf.data.formats.simple.poses_json import POSES
from biresnerf.data.formats.transforms.write_transforms import transforms_notes
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import REFINED, RefinedSet, refined_set
from biresnerf.data.points.refined_points import FieldPoints, with_points_of
from biresnerf.data.show.renders import picture_stems, write_orbit, write_pictures, write_view
from biresnerf.data.show.view_file import THUMBNAIL, ShownPictures, ShownView, ViewFile, write_view_file
from biresnerf.data.show.view_pictures import write_contact_sheet, write_points, write_thumbnail
from biresnerf.geometry.body_offset import BodyOffset
from biresnerf.geometry.similarity import Similarity
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.refinement.verdict.evaluate import Evaluation
from biresnerf.refinement.verdict.so_far import SoFar
from biresnerf.refinement.views.compare_rigs import BeforeAfter
from biresnerf.refinement.views.evaluation import RenderedView, ViewScore
from biresnerf.refinement.views.shown_views import Points
from biresnerf.report import PointsReport, Report
from biresnerf.viewer.report_html import write_report_html
from biresnerf.write.georeference import control_report, write_georeference
from biresnerf.write.output_folder import CONFIG, ORBIT, RENDERS, REPORT, OutputFolder

logger = logging.getLogger(__name__)

SOLID = 0.5  # opacity from which a depth means something


def write_result(
    folder: OutputFolder,
    scene: Scene,
    joint: JointParameters,
    monitor: Monitor,
    evaluation: Evaluation,
    report: Report,
    so_far: SoFar | None = None,
) -> Report:
    """Write poses in the input's frame, in the input's form and in others, the options, and last the report.

    Where the verdict keeps the input's poses, those are written, and the refined ones beside them in refined/. Once the
    result is complete, what only an unfinished run needs is removed.

    Args:
        so_far: the best poses of a run that has no verdict yet; by default the present poses.

    Returns the report with notes on what was written.

    Raises:
        Interrupted: stopped before the last export of a complete result was written.
    """
    complete = report.state == "complete"
    if complete:
        monitor.report(Progress(stage="exporting"))
    path = folder.path
    write_text(path / CONFIG, report.options.model_dump_json(indent=2))
    found = so_far.refined if so_far is not None else RefinedPoses.now(scene.dataset, joint)
    refined, refined_dataset = found.world_from_cam, found.dataset
    surface = evaluation.surface(joint.frame.unit_from_world, found.input_from_optimised)
    field = FieldPoints(*surface, refined) if np.isfinite(refined).all() else None
    returned, returned_dataset, poses, moved = refined, refined_dataset, POSES, None
    folder.remove_refined()  # of a partial result that this one follows
    verdict = report.verdict or report.verdict_so_far
    if verdict is not None and verdict.returned == "input":
        returned, returned_dataset = scene.dataset.world_from_cam, scene.dataset
        if np.isfinite(refined).all():
            # Statements about the returned poses do not hold for these.
            images = tuple(image.model_copy(update={"uncertainty": None}) for image in report.images)
            of_refined = report.model_copy(update={"images": images})
            _, moved = _write_poses(path / REFINED, scene, refined_dataset, refined, of_refined, field)
            poses = f"{REFINED}/{POSES}"
    # A run that is stopped must end soon: it leaves large exports out.
    exports, watching = (report.options.exports, monitor) if complete else ((), Monitor())
    finite = np.isfinite(returned).all()
    reference = write_georeference(returned_dataset, returned, path) if finite else None
    control = control_report(returned_dataset, returned) if finite else None
    distance = KnownDistance.of(report.options.known_distance, scene.dataset)
    scale = distance.scale(returned) if distance is not None else None
    report = report.model_copy(
        update={"geo_reference": reference, "control_points": control, "known_scale": scale}
    )
    report, result = _write_poses(path, scene, returned_dataset, returned, report, field, exports, watching)
    _write_view_file(path, scene, evaluation, moved or result, surface, poses)
    doubts = tuple(each.doubt for each in (reference, control) if each is not None and each.doubt)
    report = report.model_copy(update={"warnings": (*report.warnings, *doubts)})
    notes = write_report_html(path, report, folder.title)
    for note in notes:
        logger.warning("%s", note)
    report = report.model_copy(update={"warnings": report.warnings + notes})
    write_text(path / REPORT, report.model_dump_json(indent=2))
    if complete:
        folder.clean_up(failed=bool(report.faults))
        monitor.report_end(report.steps_done)
    return report


class ResultPictures:
    """Writes what is rendered at the end to renders/."""

    def __init__(self, folder: OutputFolder, scene: Scene) -> None:
        self._folder, self._scene = folder.path, scene

    def write_view(self, score: ViewScore) -> ShownView:
        """Write render, photo, difference and depth of one view."""
        photo = self._scene.images.image(score.image)
        stem = picture_stems(self._scene.dataset.names)[score.image]
        files = write_rendered(self._folder / RENDERS, stem, score.view, photo)
        names = {path.stem.rpartition("_")[2]: path.relative_to(self._folder).as_posix() for path in files}
        return ShownView(
            image=score.image,
            held_out=score.image in self._scene.held_out,
            width=photo.shape[1],
            height=photo.shape[0],
            psnr=score.psnr,
            pictures=ShownPictures.model_validate(names),
        )

    def write_before_after(self, views: Sequence[ShownView], renders: BeforeAfter) -> list[ShownView]:
        """Write the shown views as the verdict's two trainings render them."""
        stems, shown = picture_stems(self._scene.dataset.names), []
        for view in views:
            if view.image in renders:
                before, after = renders[view.image]
                pictures = {"before": before, "after": after}
                files = write_pictures(self._folder / RENDERS, stems[view.image], pictures)
                names = {kind: f"{RENDERS}/{file.name}" for kind, file in zip(pictures, files, strict=True)}
                view = view.model_copy(update={"pictures": view.pictures.model_copy(update=names)})
            shown.append(view)
        return shown

    def write_orbit(self, frames: Iterator[NDArray[np.generic]]) -> None:
        """Film the frames."""
        write_orbit(self._folder / ORBIT, frames)


def write_rendered(folder: Path, stem: str, view: RenderedView, photo: NDArray[np.generic]) -> list[Path]:
    """Write a rendered view beside its photo [h, w, 3]; depth is left out where nothing solid is seen."""
    depth = np.where(view.opacity > SOLID, view.depth, np.nan)
    return write_view(folder, stem, render=view.colour, photo=photo, depth=depth)


def described(
    dataset: Dataset,
    world_from_cam: NDArray[np.float64],
    report: Report,
    body_offset: BodyOffset | None = None,
) -> RefinedSet:
    """The set at poses [n, 4, 4], with what the report says of each image."""
    return refined_set(
        dataset,
        world_from_cam,
        similarity=Similarity.of(report.input_from_optimised),
        pose_sources=[image.pose_source for image in report.images],
        flags=[image.flags for image in report.images],
        uncertainty=[image.uncertainty for image in report.images],
        body_offset=body_offset,
    )


def _body_offset(dataset: Dataset, world_from_cam: NDArray[np.float64], report: Report) -> BodyOffset | None:
    """The offset between the body and these poses; None where none was found, or for views of a panorama.

    The first comparison with matches already removed one from the input's poses; the adjustment finds a better one.
    """
    said = report.input_accuracy
    if dataset.cut is not None:
        return None
    if (
        said is None
        or said.body_from_camera is None
        or np.array_equal(world_from_cam, dataset.world_from_cam)
    ):
        return dataset.body_offset
    along = np.array(said.body_from_camera_known_along, np.float64).reshape(-1, 3).T
    return BodyOffset(np.array(said.body_from_camera), said.body_from_camera_deviation, along)


def _write_poses(
    folder: Path,
    scene: Scene,
    dataset: Dataset,
    world_from_cam: NDArray[np.float64],
    report: Report,
    field: FieldPoints | None,
    exports: Sequence[str] = (),
    monitor: Monitor = Monitor(),
) -> tuple[Report, RefinedSet]:
    """Write poses [n, 4, 4] in the formats of every result, in the input's own and in the exports.

    ``dataset`` is the input, with the refined lenses where those are returned; ``field`` are points to use where no
    others are known.

    Returns the report with notes on them, and the set as written.
    """
    offset = _body_offset(scene.dataset, world_from_cam, report)
    refined = described(dataset, world_from_cam, report, offset)
    refined = with_points_of(refined, dataset.source.colmap, scene.tracks, scene.images, field)
    context = WriteContext(dataset, should_stop=monitor.should_stop)
    notes = write_result_formats(refined, folder, exports, context)
    if report.options.poses_of == "body":
        notes += write_body_beside(refined, folder, exports, context)
    notes += transforms_notes(dataset, world_from_cam)
    points = PointsReport(source=refined.points_source, count=len(refined.model.points))
    return report.model_copy(update={"points": points, "warnings": report.warnings + notes}), refined


def _write_view_file(
    folder: Path, scene: Scene, evaluation: Evaluation, refined: RefinedSet, surface: Points, poses: str
) -> None:
    """view.json and what it lists beside the renders; ``poses`` is the file that holds the poses of ``refined``."""
    images, sparse = scene.images, refined.model.points
    write_thumbnail(images.image((scene.held_out or [0])[0]), folder / THUMBNAIL)
    layers = [(refined.points_source, sparse.xyz, sparse.rgb)]
    if refined.points_source != "field":
        layers.append(("field", *surface))
    view = ViewFile(
        poses=poses,
        thumbnail=THUMBNAIL,
        contact_sheet=write_contact_sheet(images, folder),
        views=tuple(evaluation.views),
        points=write_points(layers, folder),
        orbit=ORBIT if (folder / ORBIT).is_file() else None,
    )
    write_view_file(view, folder)

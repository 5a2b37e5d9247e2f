"""The folder a refinement writes to: who may use it, and what it holds at the end."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.result_formats import write_result_formats
from biresnerf.data.formats.simple.poses_json import POSES, write_poses_json
from biresnerf.data.formats.transforms.write_transforms import transforms_notes, write_transforms
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet, refined_set
from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.points.refined_points import with_points_of
from biresnerf.data.show.renders import picture_stems, write_orbit, write_view
from biresnerf.data.show.view_file import THUMBNAIL, ShownPictures, ShownView, ViewFile, write_view_file
from biresnerf.data.show.view_pictures import write_contact_sheet, write_points, write_thumbnail
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.similarity import Similarity
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.stages.checkpoint import CHECKPOINT, MATCHES, SEEDING
from biresnerf.refine.stages.history import HISTORY
from biresnerf.refine.stages.two_stages import TwoStages
from biresnerf.refine.start.input_frame import poses_in_input_frame
from biresnerf.refine.verdict.judgement import Judgement
from biresnerf.refine.verdict.run_input import RunInput
from biresnerf.refine.verdict.run_report import run_report
from biresnerf.refine.views.evaluation import ViewScore, render_view
from biresnerf.refine.views.shown_views import Points, Shown
from biresnerf.report import PointsReport, Report
from biresnerf.stages import ReusableStage
from biresnerf.viewer.report_html import write_report_html

logger = logging.getLogger(__name__)

REPORT, CONFIG, TRANSFORMS = "report.json", "config.json", "transforms.json"
RENDERS, ORBIT = "renders", "orbit.mp4"
PREVIEW, REFINED = "preview", "refined"
SOLID = 0.5  # opacity from which a depth means something
_ANOTHER = "Choose another output folder, or remove this one."


class OutputFolder:
    """Refuses folders that hold something else; before `claim` it creates what COLMAP answered and previews alone."""

    def __init__(self, path: Path, *, keep_reusable: bool = False) -> None:
        self.path, self._keep_reusable = Path(path), keep_reusable

    def refuse_finished(self) -> None:
        """Raise `InputError` unless the folder is new, empty, or holds an unfinished run."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError("output_not_a_folder", "is a file.", where=str(self.path), hint="Name a folder.")
        if not self.path.is_dir() or (self.path / CHECKPOINT).is_file():
            return
        if not {path.name for path in self.path.iterdir()} - {CHECKPOINT.parent.name, HISTORY, PREVIEW}:
            return  # new, or killed before the first checkpoint
        report = self.path / REPORT
        if report.is_file():
            raise InputError(
                "output_finished", "holds a finished result.", where=str(self.path), hint=_ANOTHER
            )
        raise InputError(
            "output_not_empty",
            "is not empty, and nothing in it can be resumed.",
            where=str(self.path),
            hint=_ANOTHER,
        )

    @property
    def seeding(self) -> Path:
        """The file that keeps what COLMAP answered until the run is complete."""
        return self.path / SEEDING

    def kept_seeding(self) -> str | None:
        """What COLMAP answered, where it was asked."""
        return self.seeding.read_text("utf-8") if self.seeding.is_file() else None

    @property
    def matches(self) -> Path:
        """The file that keeps the feature matches COLMAP found, until the run is complete."""
        return self.path / MATCHES

    def seeding_files(self) -> dict[ReusableStage, tuple[str, ...]]:
        """What another run can take over of it; nothing where COLMAP was not asked."""
        kept = tuple(path.as_posix() for path in (SEEDING, MATCHES) if (self.path / path).is_file())
        return {"seeding": kept} if SEEDING.as_posix() in kept else {}

    def restore_seeding(self, seeding: str | None) -> None:
        """Put back the answer that a checkpoint carried: it may have come here without its folder."""
        if seeding is not None:
            with whole_file(self.seeding) as temporary:
                temporary.write_text(seeding, "utf-8")

    def claim(self, fingerprint: str, resumed: str | None) -> None:
        """Create the folder. Raises `InputError` if the fingerprint `resumed` of its checkpoint is another one."""
        if resumed is not None and resumed != fingerprint:
            raise InputError(
                "output_not_resumable",
                "holds an unfinished run of other images, poses or options.",
                where=str(self.path),
                hint=_ANOTHER,
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def write_view(self, given: RunInput, score: ViewScore) -> ShownView:
        """Render, photo, difference and depth of one view."""
        photo = given.images.image(score.image)
        files = write_view(
            self.path / RENDERS,
            picture_stems(given.dataset.names)[score.image],
            render=score.view.colour,
            photo=photo,
            depth=np.where(score.view.opacity > SOLID, score.view.depth, np.nan),
        )
        names = {path.stem.rpartition("_")[2]: path.relative_to(self.path).as_posix() for path in files}
        return ShownView(
            image=score.image,
            held_out=score.image in given.held_out,
            width=photo.shape[1],
            height=photo.shape[0],
            psnr=score.psnr,
            pictures=ShownPictures.model_validate(names),
        )

    def write_preview(self, given: RunInput, stages: TwoStages, threads: int) -> tuple[str, ...]:
        """How far the run is: poses so far, the report on them, and one view at half the working size.

        Returns the files, relative to the output folder.
        """
        dataset, optimiser = given.dataset, stages.optimiser
        world_from_cam, similarity = poses_in_input_frame(dataset, optimiser)
        report = run_report(
            given, stages, [], None, world_from_cam, similarity, threads=threads, state="partial"
        )
        refined = optimiser.lenses.refined(dataset)
        write_transforms(refined, world_from_cam, self.path / PREVIEW / TRANSFORMS)
        write_poses_json(_described(refined, world_from_cam, report), self.path / PREVIEW / POSES)
        self._write_text(f"{PREVIEW}/{REPORT}", report.model_dump_json(indent=2))
        pictures = self._preview_pictures(given, optimiser)
        texts = [f"{PREVIEW}/{name}" for name in (POSES, REPORT, TRANSFORMS)]
        if (self.path / HISTORY).is_file():
            self._write_text(f"{PREVIEW}/{HISTORY}", (self.path / HISTORY).read_text("utf-8").rstrip("\n"))
            texts.append(f"{PREVIEW}/{HISTORY}")
        return (*texts, *(path.relative_to(self.path).as_posix() for path in pictures))

    def _preview_pictures(self, given: RunInput, optimiser: JointOptimiser) -> list[Path]:
        images, view = given.images, (given.held_out or [0])[0]
        halves = [
            camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))
            for camera in optimiser.lenses.refined_working(images.cameras)
        ]
        intrinsics = Intrinsics.from_cameras(halves).to(optimiser.device)
        pose = optimiser.poses.matrices()[view].detach()
        rendered = render_view(optimiser, pose, view, intrinsics, as_photo=True)
        pictures = write_view(
            self.path / PREVIEW,
            picture_stems(given.dataset.names)[view],
            render=rendered.colour,
            photo=area_resize(images.image(view), halves[view].width, halves[view].height) / 255,
            depth=np.where(rendered.opacity > SOLID, rendered.depth, np.nan),
        )
        return [*pictures, write_thumbnail(images.image(view), self.path / PREVIEW / THUMBNAIL)]

    def drop_preview(self) -> None:
        """Remove what was shown, and the folder where it holds nothing else."""
        shutil.rmtree(self.path / PREVIEW, ignore_errors=True)
        with suppress(OSError):  # not empty, or never made
            self.path.rmdir()

    def drop_traces(self) -> None:
        """Remove what only a run that goes on needs, and what others could start from unless that is to be kept."""
        shutil.rmtree(self.path / PREVIEW, ignore_errors=True)
        if self._keep_reusable:
            (self.path / CHECKPOINT).unlink(missing_ok=True)
        else:
            shutil.rmtree(self.path / CHECKPOINT.parent, ignore_errors=True)

    def write_orbit(self, frames: Iterator[np.ndarray]) -> None:
        """renders/orbit.mp4."""
        write_orbit(self.path / RENDERS / ORBIT, frames)

    def write_result(
        self,
        given: RunInput,
        stages: TwoStages,
        scores: list[ViewScore],
        judgement: Judgement | None = None,
        shown: Shown | None = None,
        *,
        threads: int,
        state: Literal["complete", "partial"],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> Report:
        """Poses in the input's frame, in the input's form and in others, the options, and the report, last.

        Where the verdict keeps the input's poses, those are written, and the refined ones beside them in refined/.

        Raises:
            Interrupted: ``should_stop`` said so while exports were written.
        """
        dataset, optimiser = given.dataset, stages.optimiser
        shown = shown or Shown()
        self._write_text(CONFIG, optimiser.options.model_dump_json(indent=2))
        refined, similarity = poses_in_input_frame(dataset, optimiser)
        report = run_report(
            given, stages, scores, judgement, refined, similarity, threads=threads, state=state
        )
        refined_dataset = optimiser.lenses.refined(dataset)
        returned, returned_dataset, poses, moved = refined, refined_dataset, POSES, None
        if judgement is not None and judgement.verdict.returned == "input":
            returned, returned_dataset = dataset.world_from_cam, dataset
            if np.isfinite(refined).all():
                _, moved = self._write_poses(self.path / REFINED, given, refined_dataset, refined, report, ())
                poses = f"{REFINED}/{POSES}"
        # On the way to the end nobody waits for large exports.
        exports = optimiser.options.exports if state == "complete" else ()
        report, result = self._write_poses(
            self.path, given, returned_dataset, returned, report, exports, should_stop
        )
        surface = shown.surface(optimiser.frame.unit_from_world, similarity)
        self._write_view_file(given, shown, moved or result, surface, poses)
        notes = write_report_html(self.path, report)
        for note in notes:
            logger.warning("%s", note)
        report = report.model_copy(update={"warnings": report.warnings + notes})
        self._write_text(REPORT, report.model_dump_json(indent=2))
        return report

    def _write_view_file(
        self, given: RunInput, shown: Shown, refined: RefinedSet, surface: Points, poses: str
    ) -> None:
        """view.json and what it lists beside the renders; ``poses`` is the file that says where ``refined`` is."""
        images, sparse = given.images, refined.model.points
        write_thumbnail(images.image((given.held_out or [0])[0]), self.path / THUMBNAIL)
        view = ViewFile(
            poses=poses,
            thumbnail=THUMBNAIL,
            contact_sheet=write_contact_sheet(images, self.path),
            views=tuple(shown.views),
            points=write_points(
                [(refined.points_source, sparse.xyz, sparse.rgb), ("field", *surface)], self.path
            ),
            orbit=f"{RENDERS}/{ORBIT}" if (self.path / RENDERS / ORBIT).is_file() else None,
        )
        write_view_file(view, self.path)

    @staticmethod
    def _write_poses(
        folder: Path,
        given: RunInput,
        dataset: Dataset,
        world_from_cam: np.ndarray,
        report: Report,
        exports: Sequence[str],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> tuple[Report, RefinedSet]:
        """Writes poses [n, 4, 4] in the formats of every result, in the input's own and in the exports.

        ``dataset`` is the input, with the refined lenses where those are returned.

        Returns the report with notes on them, and the set as written.
        """
        refined = _described(dataset, world_from_cam, report)
        refined = with_points_of(refined, dataset.source.colmap, given.matches, given.images)
        context = WriteContext(dataset, should_stop=should_stop)
        notes = write_result_formats(refined, folder, exports, context)
        notes += transforms_notes(dataset, world_from_cam)
        points = PointsReport(source=refined.points_source, count=len(refined.model.points))
        return report.model_copy(update={"points": points, "warnings": report.warnings + notes}), refined

    def _write_text(self, name: str, text: str) -> None:
        with whole_file(self.path / name) as temporary:
            temporary.write_text(text + "\n", "utf-8")


def _described(dataset: Dataset, world_from_cam: np.ndarray, report: Report) -> RefinedSet:
    """The set at poses [n, 4, 4], with what the report says of each image."""
    tie = report.input_from_optimised
    return refined_set(
        dataset,
        world_from_cam,
        similarity=Similarity(tie.scale, np.array(tie.rotation), np.array(tie.translation)),
        pose_sources=[image.pose_source for image in report.images],
        flags=[image.flags for image in report.images],
    )

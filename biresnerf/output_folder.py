"""The folder a refinement writes to: who may use it, and what it holds at the end."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from biresnerf.data.area_resize import area_resize
from biresnerf.data.atomic_file import whole_file
from biresnerf.data.dataset import Dataset
from biresnerf.data.images import ImageSet
from biresnerf.data.packs.write_packs import write_packs
from biresnerf.data.refined_points import with_given_points
from biresnerf.data.refined_set import refined_set
from biresnerf.data.renders import picture_stems, write_orbit, write_view
from biresnerf.data.write import write_transforms
from biresnerf.errors import InputError
from biresnerf.geometry.camera import Intrinsics
from biresnerf.geometry.pose_error import rotation_angle_deg
from biresnerf.geometry.similarity import Similarity, align_robust, align_umeyama
from biresnerf.refine.checkpoint import CHECKPOINT, SEEDING
from biresnerf.refine.evaluation import ViewScore, render_view
from biresnerf.refine.history import HISTORY
from biresnerf.refine.joint_optimiser import JointOptimiser
from biresnerf.refine.start import Start
from biresnerf.refine.two_stages import TwoStages
from biresnerf.report import HeldOut, ImageReport, Report, SimilarityReport

REPORT, CONFIG, TRANSFORMS = "report.json", "config.json", "transforms.json"
RENDERS, ORBIT = "renders", "orbit.mp4"
PREVIEW = "preview"
SOLID = 0.5  # opacity from which a depth means something
_ANOTHER = "Choose another output folder, or remove this one."


class OutputFolder:
    """Refuses folders that hold something else; creates nothing before `claim` but what COLMAP answered."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)

    def refuse_finished(self) -> None:
        """Raise `InputError` unless the folder is new, empty, or holds an unfinished run."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError("output_not_a_folder", "is a file.", where=str(self.path), mend="Name a folder.")
        if not self.path.is_dir() or (self.path / CHECKPOINT).is_file():
            return
        if not {path.name for path in self.path.iterdir()} - {CHECKPOINT.parent.name, HISTORY}:
            return  # new, or killed before the first checkpoint
        report = self.path / REPORT
        if report.is_file():
            raise InputError(
                "output_finished", "holds a finished result.", where=str(self.path), mend=_ANOTHER
            )
        raise InputError(
            "output_not_empty",
            "is not empty, and nothing in it can be resumed.",
            where=str(self.path),
            mend=_ANOTHER,
        )

    @property
    def seeding(self) -> Path:
        """The file that keeps what COLMAP answered until the run is complete."""
        return self.path / SEEDING

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
                mend=_ANOTHER,
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def write_view(self, names: tuple[str, ...], images: ImageSet, score: ViewScore) -> None:
        """Render, photo, difference and depth of one view."""
        write_view(
            self.path / RENDERS,
            picture_stems(names)[score.image],
            render=score.view.colour,
            photo=images.image(score.image),
            depth=np.where(score.view.opacity > SOLID, score.view.depth, np.nan),
        )

    def write_preview(self, dataset: Dataset, images: ImageSet, optimiser: JointOptimiser, view: int) -> None:
        """How far the run is: poses so far, and one view at half the working size."""
        world_from_cam, _ = poses_in_input_frame(dataset, optimiser)
        write_transforms(dataset, world_from_cam, self.path / PREVIEW / TRANSFORMS)
        halves = [
            camera.resized(max(1, camera.width // 2), max(1, camera.height // 2)) for camera in images.cameras
        ]
        intrinsics = Intrinsics.from_cameras(halves).to(optimiser.device)
        pose = optimiser.poses.matrices()[view].detach()
        rendered = render_view(optimiser, pose, view, intrinsics)
        write_view(
            self.path / PREVIEW,
            picture_stems(dataset.names)[view],
            render=rendered.colour,
            photo=area_resize(images.image(view), halves[view].width, halves[view].height) / 255,
            depth=np.where(rendered.opacity > SOLID, rendered.depth, np.nan),
        )

    def drop_traces(self) -> None:
        """Remove what only a run that goes on needs."""
        for name in (CHECKPOINT.parent, PREVIEW):
            shutil.rmtree(self.path / name, ignore_errors=True)

    def write_orbit(self, frames: Iterator[np.ndarray]) -> None:
        """renders/orbit.mp4."""
        write_orbit(self.path / RENDERS / ORBIT, frames)

    def write_result(
        self,
        dataset: Dataset,
        start: Start,
        images: ImageSet,
        stages: TwoStages,
        held_out: list[int],
        scores: list[ViewScore],
        *,
        threads: int,
        state: Literal["complete", "partial"],
    ) -> Report:
        """Poses in the input's frame, in the input's form and in others, the options, and the report, last."""
        optimiser = stages.optimiser
        self._write_text(CONFIG, optimiser.options.model_dump_json(indent=2))
        world_from_cam, similarity = poses_in_input_frame(dataset, optimiser)
        write_transforms(dataset, world_from_cam, self.path / TRANSFORMS)
        record = stages.record
        lost = [i for i, flag in enumerate(optimiser.camera_errors.lost.tolist()) if flag]
        images_reported = _image_reports(
            dataset,
            start,
            world_from_cam,
            held_out,
            scores,
            lost,
            stages.repair.repaired,
            optimiser.bodies.fixed,
        )
        refined = refined_set(
            dataset,
            world_from_cam,
            similarity=similarity,
            pose_sources=[image.pose_source for image in images_reported],
            flags=[image.flags for image in images_reported],
        )
        if dataset.source.colmap is not None:
            refined = with_given_points(refined, dataset.source.colmap)
        notes = write_packs(refined, self.path, optimiser.options.packs)
        report = Report(
            version=_version(),
            state=state,
            options=optimiser.options,
            images=images_reported,
            heldout=HeldOut(
                count=len(scores),
                psnr=float(np.mean([s.psnr for s in scores])),
                ssim=float(np.mean([s.ssim for s in scores])),
            )
            if scores
            else None,
            start_trials=start.trials,
            steps_done=optimiser.step_index,
            switch_step=optimiser.switch if optimiser.method.two_stages else None,
            switch_reason=record.switch_reason,
            resumed=record.resumed,
            seconds={stage: round(seconds, 3) for stage, seconds in record.seconds.items()},
            backend=optimiser.field.backend,
            device=str(optimiser.device),
            threads=threads,
            working_size=(int(images.widths.max()), int(images.heights.max())),
            input_from_optimised=SimilarityReport(
                scale=similarity.scale,
                rotation=tuple(tuple(float(v) for v in row) for row in similarity.rotation),
                translation=tuple(float(v) for v in similarity.translation),
            ),
            warnings=dataset.warnings + _lost_warnings(dataset, lost) + notes,
        )
        self._write_text(REPORT, report.model_dump_json(indent=2))
        return report

    def _write_text(self, name: str, text: str) -> None:
        with whole_file(self.path / name) as temporary:
            temporary.write_text(text + "\n", "utf-8")


def poses_in_input_frame(dataset: Dataset, optimiser: JointOptimiser) -> tuple[np.ndarray, Similarity]:
    """Refined world_from_cam [n, 4, 4] carried into the input's frame, and the similarity that does it.

    The optimisation leaves frame and scale free; what ties them down is the best similarity, robust to lost
    cameras unless the method has it otherwise, from the optimised poses to the given ones. Fixed cameras and rigs
    leave less open.
    """
    world_from_unit = optimiser.frame.unit_from_world.inverse()
    optimised = world_from_unit.apply_to_poses(optimiser.poses.poses().numpy())
    given, tied = dataset.world_from_cam, dataset.anchors
    input_from_optimised = optimiser.bodies.input_from_optimised(optimised, given)
    if input_from_optimised is None and optimiser.method.robust_frame:
        input_from_optimised = align_robust(optimised[tied], given[tied], with_rotations=True)
    elif input_from_optimised is None:
        input_from_optimised = align_umeyama(optimised[tied], given[tied])
    carried = input_from_optimised.apply_to_poses(optimised)
    return optimiser.bodies.restored(carried, given), input_from_optimised


def _lost_warnings(dataset: Dataset, lost: list[int]) -> tuple[str, ...]:
    if not lost:
        return ()
    names = ", ".join(dataset.names[i] for i in lost)
    return (f"{len(lost)} of {len(dataset)} images agree with no pose that was found: {names}.",)


def _image_reports(
    dataset: Dataset,
    start: Start,
    world_from_cam: np.ndarray,
    held_out: list[int],
    scores: list[ViewScore],
    lost: list[int],
    repaired: list[int],
    fixed: np.ndarray,
) -> tuple[ImageReport, ...]:
    given = dataset.world_from_cam
    turn = rotation_angle_deg(np.swapaxes(given[:, :3, :3], 1, 2) @ world_from_cam[:, :3, :3])
    shift = np.linalg.norm(world_from_cam[:, :3, 3] - given[:, :3, 3], axis=1)
    scored = {score.image: score for score in scores}
    return tuple(
        ImageReport(
            name=frame.name,
            pose_source=start.sources[i],
            held_out=i in held_out,
            fixed=bool(fixed[i]),
            moved_deg=float(turn[i]),
            moved_units=float(shift[i]),
            lost=i in lost,
            repaired=i in repaired,
            psnr=scored[i].psnr if i in scored else None,
            ssim=scored[i].ssim if i in scored else None,
        )
        for i, frame in enumerate(dataset.frames)
    )


def _version() -> str:
    from biresnerf import __version__

    return __version__

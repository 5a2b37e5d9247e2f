"""Previews of a running refinement: photos, poses and matches while COLMAP works, then poses and a rendered view."""

from __future__ import annotations

from biresnerf.data.formats.simple.poses_json import POSES, write_poses_json
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet, refined_set
from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.seeding.seed_poses import Seeding
from biresnerf.data.seeding.seeding_preview import write_seeding_preview
from biresnerf.data.seeding.seeding_progress import SeedingProgress
from biresnerf.data.show.history import HISTORY
from biresnerf.data.show.renders import picture_stems
from biresnerf.data.show.view_file import PREVIEW, THUMBNAIL
from biresnerf.data.show.view_pictures import write_thumbnail
from biresnerf.data.workload import matching_work
from biresnerf.forecast.run_forecast import Phase
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.verdict.run_report import Findings, run_report
from biresnerf.refinement.verdict.so_far import poses_so_far
from biresnerf.refinement.views.evaluation import render_view
from biresnerf.write.output_folder import REPORT, OutputFolder
from biresnerf.write.result import described, write_rendered

TRANSFORMS = "transforms.json"
PHASES: tuple[Phase, ...] = ("features", "matching", "mapping")  # of seeding


def write_preview(
    folder: OutputFolder, scene: Scene, optimiser: JointOptimiser, repair: LostCameraRepair, run: RunState
) -> tuple[str, ...]:
    """Write the best poses so far, the report on them, and one view as the field is now, at half the working size.

    Returns the files, relative to the output folder.
    """
    path, renderer, recipe = folder.preview, optimiser.renderer, optimiser.recipe
    so_far = poses_so_far(scene, renderer.joint, optimiser.camera_errors, recipe, run)
    found = Findings(so_far=so_far)
    report = run_report(scene, renderer, recipe, optimiser.step_state(), run.record, repair.repaired, found)
    world_from_cam, dataset = so_far.offered(scene)
    write_transforms(dataset, world_from_cam, path / TRANSFORMS)
    write_poses_json(described(dataset, world_from_cam, report), path / POSES)
    write_text(path / REPORT, report.model_dump_json(indent=2))
    names = [POSES, REPORT, TRANSFORMS]
    if run.history.path.is_file():
        write_text(path / HISTORY, run.history.path.read_text("utf-8").rstrip("\n"))
        names.append(HISTORY)
    return tuple(f"{PREVIEW}/{name}" for name in (*names, *_write_pictures(folder, scene, renderer)))


def _write_pictures(folder: OutputFolder, scene: Scene, renderer: Renderer) -> list[str]:
    """Names of the pictures of one view, held out where there is one, and of its thumbnail."""
    view = (scene.held_out or [0])[0]
    halves = [
        camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))
        for camera in renderer.joint.lenses.refined_working(scene.images.cameras)
    ]
    intrinsics = Intrinsics.from_cameras(halves).to(renderer.device)
    pose = renderer.joint.poses.matrices()[view].detach()
    rendered = render_view(renderer, pose, view, intrinsics, as_photo=True)
    photo = scene.images.image(view)
    small = area_resize(photo, halves[view].width, halves[view].height) / 255
    pictures = write_rendered(folder.preview, picture_stems(scene.dataset.names)[view], rendered, small)
    return [path.name for path in (*pictures, write_thumbnail(photo, folder.preview / THUMBNAIL))]


class SeedingPreview:
    """Shows and reports what `seed_poses` finds; in a `with` block, which removes the files after an error.

    Args:
        dataset: as it was given.
    """

    def __init__(self, dataset: Dataset, folder: OutputFolder, monitor: Monitor) -> None:
        self._dataset, self._folder, self._monitor = dataset, folder, monitor
        self._found: SeedingProgress | None = None  # until COLMAP reports
        self._counted = False  # whether all features are

    def __enter__(self) -> SeedingPreview:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._folder.remove_preview()

    def __call__(self, found: SeedingProgress) -> None:
        """Show what is known by now."""
        self._found = found
        self._forecast(found)
        given = self._dataset.posed.all()
        message = "comparing the poses with feature matches" if given else "COLMAP looks for poses"
        if found.matches:
            message += f": {len(found.matches)} pairs of photos match"
        elif found.features:
            message += f": features of {len(found.features)} of {len(self._dataset)} photos found"
        poses = refined_set(self._dataset, self._dataset.world_from_cam) if given else None
        self._show(found, poses, message)
        if found.kept is not None:
            kept = found.kept.relative_to(self._folder.path).as_posix()
            self._monitor.report(Progress(stage="seeding", message=message, checkpoint=kept))

    def _forecast(self, found: SeedingProgress) -> None:
        forecast, count = self._monitor.forecast, len(self._dataset)
        if len(found.features) < count:
            forecast.enter("features")
            forecast.advance(len(found.features) / count)
            return
        if not self._counted:
            self._counted = True
            forecast.expect(matching_work(list(found.features.values()), found.pairs))
        phase: Phase = "mapping" if found.matched else "matching"
        forecast.enter(phase)
        for earlier in PHASES[: PHASES.index(phase)]:
            forecast.left.pop(earlier, None)  # too short to be seen
        if not found.matched:
            forecast.advance(found.tried / max(1, found.pairs))

    def show_candidate(self, seeding: Seeding) -> None:
        """Show the first candidate, if COLMAP ran; others may be tried before any pose moves."""
        if self._found is None:
            return
        first = seeding.candidates[0]
        poses = refined_set(
            seeding.dataset,
            first.world_from_cam,
            given=[frame.world_from_cam for frame in self._dataset.frames],
            pose_sources=first.sources,
        )
        self._show(self._found, poses, f"{len(poses)} poses to start from")

    def _show(self, found: SeedingProgress, poses: RefinedSet | None, message: str) -> None:
        paths = write_seeding_preview(self._dataset, found, self._folder.preview, poses)
        shown = tuple(f"{PREVIEW}/{path.name}" for path in paths)
        self._monitor.report(Progress(stage="seeding", message=message, preview=shown))

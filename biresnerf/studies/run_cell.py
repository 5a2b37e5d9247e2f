"""The process of one cell: `python -m biresnerf.studies.run_cell FOLDER` reads cell.json there, writes result.json."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf import __version__
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import Interrupted
from biresnerf.geometry.pose_error import PoseError, camera_errors, pose_error
from biresnerf.geometry.similarity import align_by_spread, align_robust
from biresnerf.pipeline import Observer, refine_poses
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import find_method
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.views.image_metrics import psnr, ssim
from biresnerf.report import Report
from biresnerf.stages import CHECKPOINT
from biresnerf.studies.cell import (
    CELL,
    EXIT_STOPPED,
    RESULT,
    RUN,
    TEST_VIEWS,
    CameraResult,
    Cell,
    CellResult,
    Outcome,
    ViewQuality,
)
from biresnerf.studies.depth_error import depth_error
from biresnerf.studies.novel_views import lpips_absent, lpips_vgg, render_test_views
from biresnerf.studies.scenes import StartingRig, read_scene, read_test_views, starting_rig, with_poses


class StopRequest:
    """Whether to stop: after SIGINT or SIGTERM, or when the parent process has ended."""

    def __init__(self) -> None:
        self._asked, self._parent = False, os.getppid()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, *_: object) -> None:
        self._asked = True

    def __call__(self) -> bool:
        return self._asked or os.getppid() != self._parent


class TruthObserver:
    """Measures a run against the true poses [n, 4, 4]: at each check, and on test views at the end."""

    def __init__(self, truth: NDArray[np.float64], test_views: Dataset | None) -> None:
        self.truth, self.test_views = truth, test_views
        self.quality: ViewQuality | None = None
        self.matched: PoseError | None = None
        self.depth_error: float | None = None
        self.seconds = 0.0

    def at_check(self, poses: NDArray[np.float64]) -> dict[str, float]:
        """Errors after BARF's alignment, as in the tables: mean rotation and mean centre."""
        errors = camera_errors(align_by_spread(poses, self.truth).apply_to_poses(poses), self.truth)
        return {
            "rotation_deg": float(errors.rotation_deg.mean()),
            "rotation_median_deg": float(np.median(errors.rotation_deg)),
            "centre": float(errors.centre.mean()),
        }

    def at_end(self, scene: Scene, optimiser: JointOptimiser) -> None:
        matched = scene.start.matched_poses
        if matched is not None:
            self.matched = matched_error(matched, scene.dataset.world_from_cam, self.truth)
        self.depth_error = depth_error(scene, optimiser.renderer, self.truth)
        if self.test_views is None:
            return
        started = time.monotonic()
        views = list(render_test_views(optimiser, self.test_views, self.truth))
        pairs = [(view.render, view.photo) for view in views]
        masked = [(view.render, view.photo, view.counts) for view in views]
        distances, absent = _perceptual(pairs)
        self.quality = ViewQuality(
            kind="test",
            count=len(pairs),
            psnr=float(np.mean([psnr(*view) for view in masked])),
            ssim=float(np.mean([ssim(*view) for view in masked])),
            unshared_opacity=float(np.mean([view.unshared for view in views])),
            depth_error=self.depth_error,
            lpips=distances,
            lpips_absent=absent,
        )
        self.seconds = time.monotonic() - started


def matched_error(
    matched: NDArray[np.float64], given: NDArray[np.float64], truth: NDArray[np.float64]
) -> PoseError:
    """Error of the cameras that feature matches placed, aligned by them; the others stand at their given poses.

    Args:
        matched, given, truth: world_from_cam [n, 4, 4].
    """
    placed = (matched != given).any(axis=(1, 2))
    return pose_error(matched[placed], truth[placed])


def run_cell(folder: Path, should_stop: Callable[[], bool]) -> CellResult:
    """Run the cell of `folder`/cell.json and measure its result; resumes from a checkpoint."""
    cell = Cell.model_validate_json((folder / CELL).read_text("utf-8"))
    run = folder / RUN
    if not (run / CHECKPOINT).is_file():
        shutil.rmtree(run, ignore_errors=True)
    dataset = read_scene(cell.scene)
    truth = dataset.world_from_cam
    rig = starting_rig(truth, cell.start)
    observer = TruthObserver(truth, read_test_views(cell.scene))
    report = refine_poses(
        with_poses(dataset, rig.world_from_cam),
        run,
        cell.options,
        should_stop=should_stop,
        observer=Observer(observer.at_check, observer.at_end),
        method=changed(find_method(cell.options.method), cell.method),
    )
    # Measure what a user would receive: the poses read back from the file.
    refined = np.stack(list(read_poses(run / "transforms.json").values()))
    outcome = Outcome(
        version=__version__,
        options=report.options,
        before=pose_error(rig.world_from_cam, truth),
        after=pose_error(refined, truth),
        matched=observer.matched,
        cameras=_cameras(dataset.names, rig, refined, truth),
        views=observer.quality or _held_out_quality(report, run, observer.depth_error),
        verdict=report.verdict.verdict if report.verdict else None,
        chosen=next((candidate.name for candidate in report.candidates if candidate.chosen), None),
        switch_step=report.switch_step,
        switch_reason=report.switch_reason,
        seconds={**report.seconds, TEST_VIEWS: round(observer.seconds, 3)},
        peak_memory_bytes=peak_memory_bytes(),
        backend=report.backend,
        device=report.device,
        threads=report.threads,
        resumed=report.resumed,
    )
    return CellResult(cell=cell, outcome=outcome)


def _cameras(
    names: tuple[str, ...], rig: StartingRig, refined: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[CameraResult, ...]:
    before, after = (
        camera_errors(align_robust(poses, truth).apply_to_poses(poses), truth).rotation_deg
        for poses in (rig.world_from_cam, refined)
    )
    return tuple(
        CameraResult(
            name=name, displaced=i in rig.displaced, before_deg=float(before[i]), after_deg=float(after[i])
        )
        for i, name in enumerate(names)
    )


def _held_out_quality(report: Report, run: Path, depth_error: float | None) -> ViewQuality | None:
    if report.heldout is None:
        return None
    pairs = []
    for render in sorted((run / "renders").glob("*_render.png")):
        photo = render.with_name(render.name.replace("_render.png", "_photo.png"))
        images = [torch.from_numpy(imageio.imread(path)[..., :3] / 255.0) for path in (render, photo)]
        pairs.append((images[0], images[1]))
    distances, absent = _perceptual(pairs)
    return ViewQuality(
        kind="held out",
        count=report.heldout.count,
        psnr=report.heldout.psnr,
        ssim=report.heldout.ssim,
        unshared_opacity=report.heldout.unshared_opacity,
        depth_error=depth_error,
        lpips=distances,
        lpips_absent=absent,
    )


def _perceptual(pairs: list[tuple[torch.Tensor, torch.Tensor]]) -> tuple[float | None, str | None]:
    """Mean LPIPS, or the reason why there is none."""
    absent = lpips_absent()
    if absent is not None:
        return None, absent
    distance = lpips_vgg()
    return float(np.mean([distance(*pair) for pair in pairs])), None


def peak_memory_bytes() -> int:
    """Peak memory of this process. Linux's VmHWM, as ru_maxrss starts with the parent's."""
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def main() -> int:
    """Run the cell of the folder in ``argv[1]``; returns the exit status."""
    folder = Path(sys.argv[1])
    try:
        result = run_cell(folder, StopRequest())
    except Interrupted:
        return EXIT_STOPPED
    write_text(folder / RESULT, result.model_dump_json(indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What a killed run leaves: ``python -m benchmarks.runs.anytime SET... [--at 20,30,40] [--preset fast] [--seed 1]``.

Each SET holds true poses, which get BARF's noise (0.15). For each moment a process begins to refine them and is killed
so many seconds after its start, by SIGKILL. Prints the true error of the poses that its folder holds then (mean
rotation, and centres in percent of the cameras' distance), and what is said of them: the verdict so far, the matches'
error that it is by, and how far the run was. The input's own error stands above. With ``--noise 0`` the true poses are
given.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from biresnerf import pipeline
from biresnerf.commands.settings_option import parse_settings
from biresnerf.compile_kernels import compile_kernels
from biresnerf.data.formats.simple.poses_json import POSES, matrix_of, read_poses_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.show.view_file import PREVIEW
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import parse_options
from biresnerf.report import Report
from biresnerf.studies.scenes import find_scene, read_scene, with_poses
from biresnerf.write.output_folder import REPORT

KEPT_INPUT = "the input's poses"


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes:
        settings: of its options, ``KEY=VALUE``.
    """

    path: Path
    preset: str
    noise: float
    seed: int
    settings: tuple[str, ...] = ()

    def truth(self) -> Dataset:
        """The set with its true poses."""
        return read_scene(find_scene(self.path, 1, test_views=0))

    def given(self) -> Dataset:
        """The set with noisy poses."""
        truth = self.truth()
        if self.noise == 0:
            return truth
        return with_poses(truth, perturb_poses(truth.world_from_cam, self.noise, seed=self.seed))

    def refine(self, output: Path) -> None:
        """The whole of it."""
        asked = {"preset": self.preset, "seed": self.seed, **parse_settings(self.settings)}
        pipeline.refine_poses(self.given(), output, parse_options(asked))

    def killed_after(self, seconds: float, output: Path) -> None:
        """The first seconds of it, in a process of its own that is killed then."""
        command = [sys.executable, "-m", "benchmarks.runs.anytime", str(self.path), "--run", str(output)]
        command += ["--preset", self.preset, "--noise", str(self.noise), "--seed", str(self.seed)]
        child = subprocess.Popen([*command, *(f"--set={setting}" for setting in self.settings)])
        try:
            child.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def left_behind(output: Path, truth: Dataset) -> str:
    """Cells of a table: the error of the poses in a folder, and what its report says of them."""
    folder = output / PREVIEW if (output / PREVIEW / POSES).is_file() else output
    if not (folder / POSES).is_file():
        return " no poses yet | | | |"
    document = read_poses_json(folder / POSES)
    poses = {image.name: matrix_of(image.world_from_cam) for image in document.images}
    cells = f" {error_cells(np.stack([poses[name] for name in truth.names]), truth)} |"
    if not (folder / REPORT).is_file():
        return f"{cells} looking for poses to start from | |"
    report = Report.model_validate_json((folder / REPORT).read_text("utf-8"))
    verdict = report.verdict or report.verdict_so_far
    if verdict is None:
        return f"{cells} none | step {report.steps_done} |"
    whose = "" if verdict.returned == "refined" else f" ({KEPT_INPUT})"
    by = verdict.epipolar
    error = "" if by is None else f", {by.error_px.before:.2f} → {by.error_px.after:.2f} px"
    how_far = f"step {report.steps_done}" if report.state == "partial" else "complete"
    return f"{cells} {verdict.verdict}{whose}{error} | {how_far} |"


def error_cells(poses: np.ndarray, truth: Dataset) -> str:
    """Rotation and centres."""
    error = pose_error(poses, truth.world_from_cam).aligned_robust
    return f"{error.rotation_deg.mean:.3f}° | {error.centre_percent.mean:.2f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--at", default="20,30,40", help="seconds after a run's start")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--run", type=Path, metavar="OUT", help="be the run of one set that writes to this folder"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="an option of the runs"
    )
    options = parser.parse_args()
    runs = [
        Run(path, options.preset, options.noise, options.seed, tuple(options.set)) for path in options.sets
    ]
    if options.run is not None:
        runs[0].refine(options.run)
        return
    compile_kernels(field=True)
    print("| set | killed after | rotation | centres | verdict so far | run |\n|---|---|---|---|---|---|")
    for run in runs:
        truth = run.truth()
        print(
            f"| {run.path.name} | input | {error_cells(run.given().world_from_cam, truth)} | | |", flush=True
        )
        for seconds in map(float, options.at.split(",")):
            with tempfile.TemporaryDirectory() as folder:
                run.killed_after(seconds, Path(folder, "run"))
                print(f"| | {seconds:g} s |{left_behind(Path(folder, 'run'), truth)}", flush=True)


if __name__ == "__main__":
    main()

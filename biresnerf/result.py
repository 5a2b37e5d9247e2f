"""A finished result as arrays: ``biresnerf.load("out")``. Loads no torch."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.result_formats import export_result, read_result
from biresnerf.data.formats.simple.poses_json import (
    POSES,
    PoseImage,
    PosesDocument,
    matrix_of,
    read_poses_json,
)
from biresnerf.data.model.refined_set import BODY, REFINED
from biresnerf.data.show.history import HISTORY, read_history
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.formats import PosesOf, formats
from biresnerf.report import Report, Verdict
from biresnerf.viewer.report_html import read_report

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_UNKNOWN_POSE = np.full((4, 4), np.nan)
FRUSTUM = 0.08  # depth of a drawn camera, of the cameras' spread


@dataclass(frozen=True, eq=False)
class Result:
    """A finished result.

    Poses are world_from_cam [n, 4, 4] with OpenCV axes (x right, y down, z forward), in the input's own frame and
    scale. They are in the order of `names`.

    Attributes:
        folder: where the result lies.
        report: what `report.json` holds.
        names: of the images, as the input writes them.
        poses: the poses returned: the refined ones, or the input's where refinement did not help.
        poses_refined: the refined ones in either case.
        poses_before: the input's; NaN for an image that had none.
        intrinsics: each image's camera at full size, as returned.
        covariance: [n, 6, 6] of `poses`, NaN where it is not known: mean square errors of the rotation vector (rad),
            then of the centre, along the axes of the input's world.
        history: the training curve: an array for each column of `history.jsonl`, NaN where a line lacks it.
    """

    folder: Path
    report: Report
    names: tuple[str, ...]
    poses: Array
    poses_refined: Array
    poses_before: Array
    intrinsics: tuple[Camera, ...]
    covariance: Array
    history: dict[str, NDArray[np.generic]]

    @property
    def verdict(self) -> Verdict | None:
        """Whether refinement helped, and why; None for a partial result, or if no verdict was requested."""
        return self.report.verdict

    @cached_property
    def rotated_deg(self) -> Array:
        """The angle [n] between each pose before and the returned one, degrees."""
        return rotation_between_deg(self.poses_before, self.poses)

    @cached_property
    def moved(self) -> Array:
        """The distance [n] between each camera's centre before and the returned one, in the input's unit."""
        return np.asarray(np.linalg.norm(self.poses[:, :3, 3] - self.poses_before[:, :3, 3], axis=1))

    @property
    def poses_of_body(self) -> Array | None:
        """Refined world_from_body [n, 4, 4] of the body that carries the camera, such as a robot's flange or a phone.

        As the input has them, where its poses were those of such a body (`input_accuracy.body_from_camera` in the
        report); None where no offset was found.
        """
        found = self.report.input_accuracy and self.report.input_accuracy.body_from_camera
        return None if found is None else self.poses_refined @ rigid_inverse(np.array(found))

    def to_colmap(self, folder: str | Path) -> Path:
        """Write the returned poses as a binary COLMAP model into `folder`, new or empty; returns it."""
        target = Path(folder)
        if target.is_dir() and any(target.iterdir()):
            raise InputError("output_not_empty", "holds files.", where=str(target), hint="Name a new folder.")
        target.mkdir(parents=True, exist_ok=True)
        write_colmap_binary(read_result(self.folder).model, target)
        return target

    def export(
        self, folder: str | Path, *names: str, photos: str | Path | None = None, poses_of: PosesOf = "camera"
    ) -> tuple[Path, ...]:
        """Write the returned poses in further formats into `folder`, as ``biresnerf export`` does.

        Args:
            names: of the formats, as docs/formats.md lists them: ``"nerfstudio", "llff"``.
            photos: the input's folder, which formats that hold photos need.
            poses_of: ``"body"``: those of the body that carries the camera, into the folder body/.

        Returns:
            the file or folder of each format.

        Raises:
            InputError: ``invalid_options``, ``export_not_possible``, or a code of the readers.
        """
        known = [name for name, one in formats().items() if one.of_result]
        for name in names:
            if name not in known:
                near = get_close_matches(name, known, 1)
                said = f"unknown format (did you mean `{near[0]}`?)." if near else "unknown format."
                raise InputError("invalid_options", said, where=name, hint=f"There are {', '.join(known)}.")
        refined = read_result(self.folder, None if photos is None else Path(photos))
        written, notes = export_result(refined, Path(folder), names, WriteContext(), poses_of)
        for note in notes:
            warnings.warn(note, stacklevel=2)
        target = Path(folder) / BODY if poses_of == "body" else Path(folder)
        return tuple(target / formats()[name].in_result for name in written)

    def plot_cameras(self, axes: Axes | None = None) -> Axes:
        """Draw the cameras before (grey) and after (blue); needs matplotlib."""
        import matplotlib.pyplot as plt

        if axes is None:
            axes = plt.figure(layout="constrained").add_subplot(projection="3d")
        spread = float(np.linalg.norm(self.poses[:, :3, 3].std(0)))
        for poses, colour, label in ((self.poses_before, "0.6", "before"), (self.poses, "tab:blue", "after")):
            lines = _frusta(poses, self.intrinsics, FRUSTUM * spread)
            for i, line in enumerate(lines):
                axes.plot(*line.T, color=colour, linewidth=0.8, label=label if i == 0 else None)
        axes.set_aspect("equal")
        axes.legend()
        return axes

    def __repr__(self) -> str:
        return f"<Result of {len(self.names)} images in {self.folder}: {self._headline}>"

    def _repr_html_(self) -> str:
        """The card that a notebook shows."""
        rows = {
            "images": str(len(self.names)),
            "rotated, median": f"{np.nanmedian(self.rotated_deg):.3g}°"
            if self._any_before
            else "no poses before",
            "final render, PSNR": "none"
            if self.report.heldout is None
            else f"{self.report.heldout.psnr:.2f} dB",
            "folder": str(self.folder),
        }
        table = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in rows.items())
        notes = "".join(f"<li>{escape(warning)}</li>" for warning in self.report.warnings)
        listed = f"<ul>{notes}</ul>" if notes else ""
        return f"<p><b>{escape(self._headline)}</b></p><table>{table}</table>{listed}"

    @property
    def _headline(self) -> str:
        return self.report.state if self.verdict is None else self.verdict.in_words()[0]

    @property
    def _any_before(self) -> bool:
        return bool(np.isfinite(self.poses_before).any())


def load(folder: str | Path) -> Result:
    """The result in `folder`, which `refine` wrote or a client downloaded.

    Raises:
        InputError: ``result_missing``, or a code of the readers.
    """
    root = Path(folder)
    report, document = read_report(root), read_poses_json(root / POSES)
    poses, images, kept = _poses(document), document.images, root / REFINED / POSES
    return Result(
        folder=root,
        report=report,
        names=tuple(image.name for image in images),
        poses=poses,
        poses_refined=_poses(read_poses_json(kept)) if kept.is_file() else poses,
        poses_before=np.array(
            [
                _UNKNOWN_POSE if i.world_from_cam_before is None else matrix_of(i.world_from_cam_before)
                for i in images
            ]
        ),
        intrinsics=tuple(document.cameras[image.camera] for image in images),
        covariance=np.array([_covariance(image) for image in images]),
        history=_columns(root / HISTORY),
    )


def _poses(document: PosesDocument) -> Array:
    return np.array([matrix_of(image.world_from_cam) for image in document.images])


def _covariance(image: PoseImage) -> Array:
    known = None if image.uncertainty is None else image.uncertainty.covariance
    return np.full((6, 6), np.nan) if known is None else np.array(known)


def _columns(path: Path) -> dict[str, NDArray[np.generic]]:
    lines = read_history(path) if path.is_file() else []
    names = dict.fromkeys(name for line in lines for name in line)
    return {name: np.array([line.get(name, np.nan) for line in lines]) for name in names}


def _frusta(poses: Array, cameras: tuple[Camera, ...], depth: float) -> list[Array]:
    """A line [points, 3] for each pose: from the centre round the picture's corners."""
    lines = []
    for pose, camera in zip(poses, cameras, strict=True):
        if not np.isfinite(pose).all():
            continue
        lens = camera.full()
        x = np.array([0, camera.width, camera.width, 0]) - lens.cx
        y = np.array([0, 0, camera.height, camera.height]) - lens.cy
        corners = np.stack([x / lens.fx, y / lens.fy, np.ones(4)], 1) * depth
        path = np.array(
            [[0, 0, 0], *corners, corners[0], [0, 0, 0], corners[1], corners[2], [0, 0, 0], corners[3]]
        )
        lines.append(path @ pose[:3, :3].T + pose[:3, 3])
    return lines

"""Why a program's lens cannot hold a camera, by what the lens lacks."""

from __future__ import annotations

from collections.abc import Collection

from biresnerf.data.formats.simple.bundler import refuse_lenses
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import COEFFICIENTS, Camera

BROWN = ("k1", "k2", "k3", "p1", "p2")
FISHEYE = ("k1", "k2", "k3", "k4")
_HINT = "Export `pinhole`, which holds undistorted photos and PINHOLE cameras."


def refuse_other_lenses(
    refined: RefinedSet, title: str, where: str, *, fisheye: bool, two_focal_lengths: bool
) -> None:
    """Raises InputError ``export_not_possible`` for a lens beyond Brown's model, or beyond the fisheye of OpenCV.

    Args:
        fisheye: whether the program has the fisheye.
        two_focal_lengths: whether it has two.
    """

    def problem(camera: Camera) -> str | None:
        full = camera.full()
        known: Collection[str] = FISHEYE if full.fisheye else BROWN
        if full.fisheye and not fisheye:
            return f"{camera.model} is a fisheye"
        if any(getattr(full, name) for name in COEFFICIENTS if name not in known):
            return f"it does not have all coefficients of {camera.model}"
        if full.fx != full.fy and not two_focal_lengths:
            return "it has two focal lengths"
        return None

    refuse_lenses(refined.cameras, problem, title, where, _HINT)

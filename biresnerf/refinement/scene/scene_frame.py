"""The unit frame: where the scene lies, how large it is, and what lies around it.

One rule for all rigs: the inner box [-1, 1]^3 is centred on the point the cameras look at and as large as what a
camera sees at that distance. A scene with a known background colour is assumed to end there, and the box is no larger
than what photos show before it; any other continues outside, contracted.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.photos.images import ImageSet
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.focus import focus_point, rms_spread
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.scene.shared_views import nearest_shared

logger = logging.getLogger(__name__)

# Half an angle of view counts as no more than this tangent (56 deg): fisheyes see to their sides.
WIDEST_SLOPE = 1.5


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """`unit_from_world` with what sampling needs to know; lengths are in units of the unit frame.

    Attributes:
        distance: mean distance of the cameras from the centre.
        pixel: what one pixel of the working size spans at that distance.
        background: colour [3], 0 to 1, behind the scene; None where the scene has surroundings.
        near: nothing nearer to a camera is sampled; a share of `distance`.
    """

    unit_from_world: Similarity
    unbounded: bool
    distance: float
    pixel: float
    far: float
    background: np.ndarray | None
    near: float = 0.0


def _slopes(images: ImageSet, image: int, pixel_xy: np.ndarray) -> np.ndarray:
    """x/z and y/z [n, 2] of the directions that pixels [n, 2] of an image look in, within `WIDEST_SLOPE`."""
    intrinsics = Intrinsics.from_cameras([images.cameras[image]])
    index = torch.zeros(len(pixel_xy), dtype=torch.int64)
    ray = directions_in_cam(intrinsics, index, torch.from_numpy(pixel_xy.astype(np.float64))).numpy()
    across, ahead = ray[:, :2], ray[:, 2:]
    beyond = np.abs(across) >= WIDEST_SLOPE * ahead
    return np.where(beyond, WIDEST_SLOPE * np.sign(across), across / np.where(beyond, 1.0, ahead))


def _half_angle_tangent(images: ImageSet) -> float:
    """Tangent of half the angle of view along the longer side, of most cameras."""
    tangents: dict[Camera, float] = {}
    for i, camera in enumerate(images.cameras):
        if camera not in tangents:
            full, w, h = camera.full(), camera.width, camera.height
            x, y = min(max(full.cx, 0.0), float(w)), min(max(full.cy, 0.0), float(h))
            slopes = _slopes(images, i, np.array([[0, y], [w, y], [x, 0], [x, h]]))
            tangents[camera] = float(max(slopes[1, 0] - slopes[0, 0], slopes[3, 1] - slopes[2, 1])) / 2
    return float(np.median([tangents[camera] for camera in images.cameras]))


def _content_reach(poses: NDArray[np.float64], images: ImageSet, centre: NDArray[np.float64]) -> float | None:
    """How far from `centre` photos show anything, at its distance; None before surroundings.

    Of poses [n, 4, 4] or several sets of them. Noisy poses see it farther from there, so the box has room for them.
    """
    reach = []
    for i in range(len(images)):
        box = images.content_box(i)
        if box is None:
            continue
        slopes = _slopes(images, i, box)
        for pose in poses[i :: len(images)]:
            x, y, depth = pose[:3, :3].T @ (centre - pose[:3, 3])
            if depth > 0:
                reach.append(np.abs(slopes * depth - [x, y]).max())
    return float(np.quantile(reach, 0.9)) if reach else None


def _pixel_slope(images: ImageSet) -> float:
    """What one pixel spans at the image's centre, at a distance of one."""
    spans = [max(c.width / c.full().fx, c.height / c.full().fy) for c in images.cameras]
    return float(np.median(spans) / np.median([max(c.width, c.height) for c in images.cameras]))


def scene_frame(
    poses: np.ndarray, images: ImageSet, numbers: FrameNumbers, depth: float | None = None
) -> SceneFrame:
    """The unit frame of a set, from its poses world_from_cam [n, 4, 4] (noisy ones will do) and images.

    Several sets of poses of the same images, one after the other, get a frame that suits them all. Where the optical
    axes do not meet, the scene is assumed to lie at ``depth`` in front of the cameras, in the poses' unit.
    """
    centres = poses[:, :3, 3]
    focus = focus_point(poses)
    centre, distance = focus.point, focus.mean_distance
    if focus.conditioning < numbers.converging or focus.in_front < 0.5:
        spread = rms_spread(centres)
        axis = poses[:, :3, 2].mean(0)
        length = float(np.linalg.norm(axis))
        forward = axis / length if length > 0.2 else np.zeros(3)
        guess = numbers.forward_facing_depth * spread if spread > 0 else 1.0
        distance = guess if depth is None else depth
        centre = centres.mean(0) + distance * forward
        logger.info("optical axes do not meet: taking the scene %.3g ahead of the cameras", distance)
    half = distance * _half_angle_tangent(images)
    reach = _content_reach(poses, images, centre)
    if reach is not None:
        half = min(half, numbers.content_margin * reach)
    unit_from_world = Similarity(1 / half, np.eye(3), -centre / half)
    near = 0.0
    if images.background is None:
        intrinsics, rigs = Intrinsics.from_cameras(images.cameras), poses.reshape(-1, len(images), 4, 4)
        near = min(nearest_shared(rig, intrinsics, distance, numbers) for rig in rigs)
    return SceneFrame(
        unit_from_world=unit_from_world,
        unbounded=images.background is None,
        distance=distance / half,
        pixel=_pixel_slope(images) * distance / half,
        far=numbers.far_boxes if images.background is None else 4 * distance / half + 4,
        background=images.background,
        near=near,
    )

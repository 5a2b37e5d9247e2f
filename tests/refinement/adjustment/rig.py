"""A rig of known cameras around random points, and what its cameras observe."""

import numpy as np
import torch

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread

SIZE, FOCAL = 400, 500.0


def look_at_origin(centres):
    """Poses [n, 4, 4] of cameras at `centres` [n, 3] that look at the origin, z up."""
    forward = -centres / np.linalg.norm(centres, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 2)
    poses[:, :3, 3] = centres
    return poses


def ring(count, rng):
    """Poses of cameras on a dome of radius 4."""
    azimuth = 2 * np.pi * np.arange(count) / count
    height = rng.uniform(0.2, 0.9, count)
    flat = np.sqrt(1 - height**2)
    return look_at_origin(4 * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], 1))


def pinholes(count):
    camera = Camera("PINHOLE", SIZE, SIZE, (FOCAL, FOCAL * 1.01, 201.0, 199.0))
    return Intrinsics.from_cameras([camera] * count)


def observed(poses, points, intrinsics, rng, noise_px=0.0, seen_by=6):
    """Tracks of points [p, 3], each seen by so many cameras."""
    seen_by = min(seen_by, len(poses))
    point = np.repeat(np.arange(len(points)), seen_by)
    image = np.concatenate([np.sort(rng.permutation(len(poses))[:seen_by]) for _ in points])
    in_cam = np.einsum("mji,mj->mi", poses[image, :3, :3], points[point] - poses[image, :3, 3])
    xy = project(intrinsics, torch.from_numpy(image), torch.from_numpy(in_cam)).numpy()
    return Tracks(point, image, xy + rng.normal(0, noise_px, xy.shape))


def disturbed(poses, rng, rotation, position):
    """Poses with independent errors: rad of each axis, and the poses' unit."""
    turn = so3_exp(torch.from_numpy(rng.normal(0, rotation, (len(poses), 3)))).numpy()
    moved = poses.copy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] += rng.normal(0, position, (len(poses), 3))
    return moved


def rotation_errors_deg(poses, truth):
    """Of each camera, after alignment."""
    return camera_errors(align_by_spread(poses, truth).apply_to_poses(poses), truth).rotation_deg

"""``scene.glb``: cameras before (grey) and after (coloured by how far they turned), and the points; for any 3-D viewer.

Positions are the caller's world. glTF is y up and Blender z up, and Blender's importer turns the one into the other;
the node above all meshes turns back beforehand, so that Blender shows the caller's own coordinates. Other viewers
show z upwards. Frusta have edges and faint faces, as some readers (Open3D) take triangles only.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.simple.glb_file import LINES, POINTS, GlbFile
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.show.renders import ramp_colours
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.options.formats import Format

SCENE = Format(
    name="scene",
    title="scene.glb",
    rank=40,
    in_set="scene.glb",
    always=True,
    loses=("lenses", "rigs"),
    heading="For Blender",
    hint="Cameras before and after, and points: File › Import › glTF",
)

GREY = (150, 150, 150)
TURN_AT_TOP_DEG = 10.0  # that the brightest colour stands for, in every file
MOST_POINTS = 200_000  # a viewer's file, not an archive
_Y_UP_FROM_Z_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]  # quaternion x, y, z, w
# Corners 1 to 4 around the picture from its top left, the centre 0, and a tip 5 above its top edge.
_EDGES = np.array(
    [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2)], dtype=np.uint32
)
_FACES = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (1, 5, 2)], dtype=np.uint32)


def write_scene(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all."""
    after = refined.world_from_cam
    centre = after[:, :3, 3].mean(0)
    depth = _depth(after)
    glb = GlbFile(
        extras={
            "colours": f"cameras after: dark violet 0, yellow {TURN_AT_TOP_DEG:g} degrees of turn and more",
            "world": "the input's",
            "frustum_depth": depth,
        }
    )
    before = [i for i, image in enumerate(refined.images) if image.given is not None]
    if before:
        given = np.stack([image.given for image in refined.images if image.given is not None])
        vertices = _frusta(refined, before, given, depth, centre)
        grey = np.tile(np.array(GREY, np.uint8), (len(vertices), 1))
        glb.add_mesh("cameras before", LINES, vertices, grey, *_parts(len(before)))
    vertices = _frusta(refined, range(len(refined)), after, depth, centre)
    colours = np.repeat(_turn_colours(refined), 6, axis=0)
    glb.add_mesh("cameras after", LINES, vertices, colours, *_parts(len(refined)))
    points = refined.model.points
    if len(points):
        step = -(-len(points) // MOST_POINTS)
        glb.add_mesh("points", POINTS, points.xyz[::step] - centre, points.rgb[::step])
    # The rotation goes before the translation in a node, so the translation is the turned centre.
    x, y, z = centre.tolist()
    root = {"name": "world", "rotation": _Y_UP_FROM_Z_UP, "translation": [x, z, -y]}
    content = glb.content(root)
    with whole_file(path) as temporary:
        temporary.write_bytes(content)


def _depth(world_from_cam: NDArray[np.float64]) -> float:
    """How long frusta are drawn: a share of the rig's size that shrinks as cameras crowd."""
    centres = world_from_cam[:, :3, 3]
    spread = rms_spread(centres)
    return max(spread / math.sqrt(len(centres)), 1e-9)


def _parts(cameras: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """The edges [n, 2] and faces [m, 3] of so many frusta, as indices of their vertices."""
    first = 6 * np.arange(cameras, dtype=np.uint32)[:, None, None]
    return (_EDGES + first).reshape(-1, 2), (_FACES + first).reshape(-1, 3)


def _frusta(
    refined: RefinedSet,
    which: list[int] | range,
    world_from_cam: NDArray[np.float64],
    depth: float,
    origin: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Six vertices a camera, relative to ``origin``."""
    vertices = []
    for index, pose in zip(which, world_from_cam, strict=True):
        camera = refined.camera_of(index)
        full = camera.full()
        # The picture's corners by focal lengths alone: a drawing, and distorted lenses may have no other.
        left, right = -full.cx / full.fx, (camera.width - full.cx) / full.fx
        top, bottom = -full.cy / full.fy, (camera.height - full.cy) / full.fy
        tip = top - 0.4 * (bottom - top)
        corners = [(left, top), (right, top), (right, bottom), (left, bottom), ((left + right) / 2, tip)]
        in_cam = depth * np.array([(0.0, 0.0, 0.0), *((x, y, 1.0) for x, y in corners)])
        vertices.append(in_cam @ pose[:3, :3].T + (pose[:3, 3] - origin))
    return np.concatenate(vertices)


def _turn_colours(refined: RefinedSet) -> NDArray[np.uint8]:
    """A colour [n, 3] by the angle that each camera turned; the brightest where there was no pose before."""
    turned = [
        TURN_AT_TOP_DEG
        if image.given is None
        else float(rotation_between_deg(image.given[None], image.world_from_cam[None])[0])
        for image in refined.images
    ]
    return ramp_colours(np.array(turned) / TURN_AT_TOP_DEG)


CODECS = (Codec(SCENE, write=lambda refined, path, _: write_scene(refined, path)),)

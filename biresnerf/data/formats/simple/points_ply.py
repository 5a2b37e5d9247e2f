"""``points.ply``: the set's points with their colours, in its world; what splatting starts from and viewers show.

Layout: binary little-endian PLY with the properties that 3D Gaussian Splatting reads (fetchPly of
scene/dataset_readers.py: x y z, nx ny nz, red green blue), and so nerfstudio, Open3D and CloudCompare. Positions are
doubles, as coordinates of a map would lose digits; normals are zero, as 3DGS writes them itself.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from biresnerf.data.formats.codec import Codec, cannot_hold
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.options.formats import Format

POINTS_PLY = Format(
    name="points",
    title="points.ply",
    rank=41,
    in_set="points.ply",
    always=True,
    loses=("poses", "lenses", "rigs"),
    heading="For CloudCompare and Open3D",
    hint="The points with their colours, as a point cloud",
)

_XYZ, _NORMAL, _RGB = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
# NumPy's type of each group of properties, and PLY's.
_GROUPS = ((_XYZ, "<f8", "double"), (_NORMAL, "<f4", "float"), (_RGB, "u1", "uchar"))
_VERTEX = np.dtype([(name, kind) for names, kind, _ in _GROUPS for name in names])


def write_points_ply(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all.

    Raises:
        InputError: ``export_not_possible``: there are no points.
    """
    points = refined.model.points
    if not len(points):
        raise cannot_hold(
            path.name,
            "there are no points, and programs that start from them (splatting) cannot.",
            "Refine the poses: a result has points wherever they can be found.",
        )
    vertices = np.zeros(len(points), _VERTEX)
    for column, name in enumerate(_XYZ):
        vertices[name] = points.xyz[:, column]
    for column, name in enumerate(_RGB):
        vertices[name] = points.rgb[:, column]
    properties = [f"property {kind} {name}" for names, _, kind in _GROUPS for name in names]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *properties,
        "end_header",
    ]
    with whole_file(path) as temporary:
        temporary.write_bytes("\n".join([*head, ""]).encode() + vertices.tobytes())


CODECS = (Codec(POINTS_PLY, write=lambda refined, path, _: write_points_ply(refined, path)),)

"""All packs by name: which files each writes, and why one cannot be written where it cannot."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.formats.simple.bundler import write_bundler
from biresnerf.data.formats.simple.pinhole import PINHOLE, write_pinhole
from biresnerf.data.formats.simple.poses_json import POSES, write_poses_json
from biresnerf.data.formats.simple.scene_glb import SCENE, write_scene
from biresnerf.data.formats.simple.trajectory import write_kitti, write_tum
from biresnerf.data.formats.transforms.instant_ngp import TRANSFORMS_NGP, write_transforms_ngp
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError
from biresnerf.options.refine_options import PackName

COLMAP, COLMAP_TEXT = Path("colmap") / "sparse" / "0", Path("colmap") / "sparse_txt" / "0"

# Written with every result: small, and enough to make the others from.
ALWAYS: dict[str, Callable[[RefinedSet, Path], None]] = {
    "colmap": lambda refined, folder: write_colmap_binary(refined.model, folder / COLMAP),
    "tum": lambda refined, folder: write_tum(refined, folder / "tum.txt"),
    "scene": lambda refined, folder: write_scene(refined, folder / SCENE),
    "poses": lambda refined, folder: write_poses_json(refined, folder / POSES),
}
# Those that take long ask whether to stop, and raise `Interrupted`.
ON_REQUEST: dict[PackName, Callable[[RefinedSet, Path, Callable[[], bool]], None]] = {
    "colmap-text": lambda refined, folder, _: write_colmap_text(refined.model, folder / COLMAP_TEXT),
    "instant-ngp": lambda refined, folder, _: write_transforms_ngp(refined, folder / TRANSFORMS_NGP),
    "kitti": lambda refined, folder, _: write_kitti(refined, folder / "kitti.txt"),
    "bundler": lambda refined, folder, _: write_bundler(refined, folder / "bundler"),
    "pinhole": lambda refined, folder, stop: write_pinhole(refined, folder / PINHOLE, stop),
}


def write_packs(
    refined: RefinedSet,
    folder: Path,
    more: Iterable[PackName] = (),
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[str, ...]:
    """Writes what belongs to every result and ``more`` into ``folder``.

    Returns:
        a sentence for each pack asked for that this set cannot be written as.

    Raises:
        Interrupted: ``should_stop`` said so.
    """
    for write in ALWAYS.values():
        write(refined, folder)
    notes = []
    for name in more:
        try:
            ON_REQUEST[name](refined, folder, should_stop)
        except InputError as error:
            notes.append(f"{name} was not written: {error}")
    return tuple(notes)

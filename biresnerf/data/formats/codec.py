"""What a module that reads or writes a format provides."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from biresnerf.data.formats.bind_images import bind_images
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import COEFFICIENTS, Camera
from biresnerf.options.formats import Format


@dataclass(frozen=True)
class WriteContext:
    """What a writer may need beside the poses.

    Attributes:
        dataset: the input; None where a finished result is read back and written again.
        bounds: depths of the nearest and farthest point, where the user gave them.
        should_stop: long writers call it, and raise `Interrupted` once it returns true.
    """

    dataset: Dataset | None = None
    bounds: tuple[float, float] | None = None
    should_stop: Callable[[], bool] = lambda: False


# The folder that images lie in or below, and the pose file (or the folder of a COLMAP model). Opens no image. Raises
# InputError, codes as in docs/input.md.
Parser: TypeAlias = Callable[[Path, Path], ParsedPoses]
# The parsed poses, the folder of the images, and the folder that no file may lie outside of.
# Raises InputError likewise.
Binder: TypeAlias = Callable[[ParsedPoses, Path, Path | None], Dataset]
# The set, the file or folder to write, which the format's declaration names, and the context. Raises InputError
# ``export_not_possible`` where the format cannot hold the set.
Writer: TypeAlias = Callable[[RefinedSet, Path, WriteContext], None]


_HEAD_BYTES = 4096


def head_of(path: Path) -> bytes:
    """The first bytes of a file; none where there is no such file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)


def head_holds(*markers: bytes) -> Callable[[Path], bool]:
    """Whether a file begins with something that holds one of these; for names that several programs use."""
    return lambda path: any(marker in head_of(path) for marker in markers)


def head_matches(pattern: bytes) -> Callable[[Path], bool]:
    """A test whether a file begins with a match of ``pattern``."""
    return lambda path: re.match(pattern, head_of(path)) is not None


# The coefficients of Brown's lens, and of OpenCV's fisheye.
BROWN, FISHEYE = ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
_CENTRED_PX = 1e-6
_PINHOLE_HINT = "Export `pinhole`, which holds undistorted photos with PINHOLE cameras, and files of them."


def cannot_hold(where: str, what: str, hint: str = _PINHOLE_HINT) -> InputError:
    """The error for a set that a format, of this name or written to ``where``, cannot hold."""
    return InputError("export_not_possible", what, where=where, hint=hint)


@dataclass(frozen=True)
class LensLimits:
    """The lenses that a program supports.

    Attributes:
        program: what people call it.
        coefficients: of its perspective lens.
        fisheye: of its fisheye; None where it has none.
        two_focal_lengths: whether pixels may be non-square.
        off_centre: whether the principal point may lie elsewhere than in the picture's middle.
        hint: what to do with other lenses.
    """

    program: str
    coefficients: Collection[str] = BROWN
    fisheye: Collection[str] | None = FISHEYE
    two_focal_lengths: bool = True
    off_centre: bool = True
    hint: str = _PINHOLE_HINT

    def problem(self, camera: Camera) -> str | None:
        """Why the program cannot hold this lens, or None where it can."""
        full = camera.full()
        known = self.fisheye if full.fisheye else self.coefficients
        if known is None:
            return f"{camera.model} is a fisheye"
        if any(getattr(full, name) for name in COEFFICIENTS if name not in known):
            return f"it does not have all coefficients of {camera.model}" if known else "it is distorted"
        if full.fx != full.fy and not self.two_focal_lengths:
            return "it has two focal lengths"
        off = max(abs(full.cx - camera.width / 2), abs(full.cy - camera.height / 2))
        return (
            "its principal point is not in the image's centre"
            if off > _CENTRED_PX and not self.off_centre
            else None
        )

    def refuse(self, cameras: Iterable[Camera], where: str) -> None:
        """Raises InputError ``export_not_possible`` for the first lens with a problem."""
        for problem in filter(None, map(self.problem, cameras)):
            what = f"{self.program} cannot hold a lens of this set: {problem}."
            raise cannot_hold(where, what, self.hint)


@dataclass(frozen=True)
class Codec:
    """A declared format with the functions that read and write it. A module lists its own in ``CODECS``.

    Attributes:
        format: the declaration.
        parse: None for formats that are only written.
        bind: how parsed poses become a dataset.
        recognises: whether what lies under one of the declared names is of this format.
        pose_place: for a file that the user names, the file or folder to be read; None where it is not of this format
            by its name.
        image_root: the folder that the images of such a place lie in or below.
        loose: whether other programs use its names and suffixes, too: it is not looked for in folders below, and a
            format that recognises a file goes first.
        count: how many images such a place has, for a format of which a set may hold several places, each with its
            photos beside: the one with most images is read.
        refuse_early: for uploaded sets, raises InputError for what would take long to parse and cannot be used: of
            the pose file, and the folder that no file may lie outside of.
        write: None for formats that are only read.
        given_back: whether this set came in this format, so that its result is written in it too.
    """

    format: Format
    parse: Parser | None = None
    bind: Binder = bind_images
    recognises: Callable[[Path], bool] = Path.is_file
    pose_place: Callable[[Path], Path | None] | None = None
    image_root: Callable[[Path], Path] = lambda place: place.parent
    loose: bool = False
    count: Callable[[Path], int] | None = None
    refuse_early: Callable[[Path, Path], None] | None = None
    write: Writer | None = None
    given_back: Callable[[Dataset], bool] = lambda dataset: False

    def write_set(self, refined: RefinedSet, path: Path, context: WriteContext) -> None:
        """Write the set. Raises InputError ``export_not_possible`` where the format cannot hold it."""
        holds = self.format.panoramas or "lenses" in self.format.loses
        if not holds and any(camera.panorama for camera in refined.cameras):
            raise cannot_hold(
                path.name, "cannot hold panoramas.", "transforms.json and formats without lenses can."
            )
        assert self.write is not None, f"{self.format.name} is written"
        self.write(refined, path, context)

    def place_of(self, file: Path) -> Path | None:
        """What is read when the user names ``file``; None where it is not of this format by its name."""
        if self.pose_place is not None:
            return self.pose_place(file)
        return file if file.suffix.lower() in self.format.suffixes else None

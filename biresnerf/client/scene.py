"""The files of a local folder that make up a scene, and the names they are sent under."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

from biresnerf.errors import InputError
from biresnerf.wire.safe_paths import NameSet, checked_path

TRANSFORMS = "transforms.json"


def look_at(path: Path, video_frames: int = 0) -> list[tuple[str, Path]]:
    """The files that make up the input at ``path``: poses with the images and masks they name, or images alone.

    Each comes with its name in the dataset. For a video, its frames are written beside it and sent, as many as the
    option ``video_frames`` says.

    Raises:
        InputError: the input cannot be used, or an image is outside its folder.
    """
    from biresnerf.data.formats.positions.control_points import control_files
    from biresnerf.data.formats.positions.position_table import position_files
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.photos.video.video_frames import VideoReading

    dataset = read_dataset(path, videos=VideoReading(video_frames))
    root = dataset.root
    images = list({frame.path.resolve(): frame.path for frame in dataset.frames}.values())
    masks = list(
        {frame.mask.resolve(): frame.mask for frame in dataset.frames if frame.mask is not None}.values()
    )
    poses = [(_name_below(root, file), file) for file in dataset.source.files]
    if dataset.source.file is not None:
        # The service looks for the pose file by its usual name.
        name = PurePosixPath(_name_below(root, dataset.source.file))
        usual = name if name.name.startswith("transforms") else name.with_name(TRANSFORMS)
        poses = [(str(usual), dataset.source.file)]
    elif dataset.source.files and not path.is_dir():
        poses = _found_by_name(root, path, poses)
    places = [(file.name, file) for file in (*position_files(root), *control_files(root))]
    files = [*poses, *places, *((_name_below(root, file), file) for file in images + masks)]
    names = NameSet()
    for sent_as, _ in files:
        names.add(sent_as)
    return files


def _found_by_name(root: Path, path: Path, poses: list[tuple[str, Path]]) -> list[tuple[str, Path]]:
    """The files, renamed so that the service detects the same format."""
    from biresnerf.data.formats.folder import usual_name

    usual = usual_name(path)
    return [(usual if usual and file == path else name, file) for name, file in poses]


def _name_below(root: Path, path: Path) -> str:
    try:
        # Not resolved: a link inside the folder may point anywhere.
        name = Path(os.path.abspath(path)).relative_to(os.path.abspath(root)).as_posix()
    except ValueError:
        raise InputError(
            "image_outside",
            "is outside the folder of the pose file and cannot be sent with it.",
            where=str(path),
            hint="Move it below that folder, or run `biresnerf refine` on this machine.",
        ) from None
    return checked_path(name)

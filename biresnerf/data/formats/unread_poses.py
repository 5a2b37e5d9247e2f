"""Poses in forms that are not read: recognised by name and first bytes, so that no set is taken for photos alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from biresnerf.errors import InputError

FIRST_BYTES = 4096


@dataclass(frozen=True)
class UnreadForm:
    """What a program calls its files, as globs from the set's folder, and what the first bytes match."""

    program: str
    names: tuple[str, ...]
    begins: bytes = b""


UNREAD = (
    UnreadForm("ContextCapture (BlocksExchange)", ("*.xml",), rb"(?s).*<BlocksExchange"),
    UnreadForm("Pix4D", ("*calibrated_external_camera_parameters.txt",), rb"imageName"),
    UnreadForm("VisualSFM", ("*.nvm",), rb"NVM_V"),
    UnreadForm("OpenMVS", ("*.mvs",), rb"MVS"),
    UnreadForm("Stray Scanner", ("odometry.csv",), rb"timestamp"),
    UnreadForm("ARKitScenes", ("*.traj",), rb"\s*([-+]?[\d.]+(e[-+]?\d+)?\s+){7}"),
)


def refuse_unread(root: Path) -> None:
    """Raise `InputError` ``poses_not_read`` if the folder holds poses of a program whose form is not read."""
    for form in UNREAD:
        for name in form.names:
            for path in sorted(root.glob(name)):
                if path.is_file() and _begins(path, form.begins):
                    raise InputError(
                        "poses_not_read",
                        f"holds camera poses of {form.program}, a form that is not read.",
                        where=path.relative_to(root).as_posix(),
                        hint="Convert them to one of the formats of docs/formats.md, or move them out of the folder to "
                        "have the poses found from the photos alone.",
                    )


def _begins(path: Path, pattern: bytes) -> bool:
    with path.open("rb") as file:
        return re.match(pattern, file.read(FIRST_BYTES)) is not None

"""``view.json``: the pictures and points of a result, for the service's page and report.html."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.untrusted_file import checked, read_json_object
from biresnerf.frozen_model import FrozenModel

VIEW, THUMBNAIL = "view.json", "thumbnail.jpg"
PREVIEW = "preview"  # folder with the previews of a run in progress
CONTACT_SHEET, POINTS = "view/contact_sheet.jpg", "view/points_{source}.bin"


class ShownPictures(FrozenModel, allow_inf_nan=False):
    """A rendered view's files, relative to the result's folder.

    `before` and `after` come from the verdict's two trainings, on the input's poses and on the refined ones.
    """

    render: str
    photo: str
    difference: str
    depth: str
    before: str | None = None
    after: str | None = None

    def files(self) -> dict[str, str]:
        """The files there are, by what they show."""
        return {kind: file for kind, file in self if file is not None}


class ShownView(FrozenModel, allow_inf_nan=False):
    """A view that was rendered at the end."""

    image: int = Field(description="Index of the image in poses.json.")
    held_out: bool = Field(description="Whether the field never learnt from its photo.")
    width: int
    height: int
    psnr: float = Field(description="Render against photo at this size, dB.")
    pictures: ShownPictures


class ContactSheet(FrozenModel, allow_inf_nan=False):
    """All photos, small, in one picture: image i lies in row i // columns, in the middle of its cell."""

    file: str
    columns: int
    cell_width: int
    cell_height: int


class ShownPoints(FrozenModel, allow_inf_nan=False):
    """Points: float32 [count, 3] positions minus origin, little-endian, then uint8 [count, 3] colours."""

    source: Literal["given", "features", "tracks", "moved", "field"] = Field(
        description="As points_source of poses.json; field: where the shown views' rays end in the radiance field."
    )
    file: str
    count: int
    origin: tuple[float, float, float]


class ViewFile(FrozenModel, allow_inf_nan=False):
    """The whole file; names of files are relative to the result's folder."""

    format: Literal["biresnerf-view"] = "biresnerf-view"
    version: Literal[1] = 1
    poses: str = Field(
        description="The poses that were refined, whatever the verdict: refined/poses.json where the result holds the "
        "input's."
    )
    thumbnail: str = Field(description="One photo that stands for the set, 320 px at most.")
    contact_sheet: ContactSheet | None = Field(description="None of more than 4,000 images.")
    views: tuple[ShownView, ...] = Field(description="Those that were rendered, held-out ones first.")
    points: tuple[ShownPoints, ...]
    orbit: str | None


def write_view_file(view: ViewFile, folder: Path) -> None:
    """Writes the file into the result's ``folder``, whole or not at all."""
    write_text(folder / VIEW, view.model_dump_json(indent=1))


def read_view_file(folder: Path) -> ViewFile:
    """The file of the result in ``folder``, checked.

    Raises:
        InputError: ``view_file_invalid``, or a code of `read_json_object`.
    """
    hint = "Leave the files of a result together, as they were written."
    return checked(ViewFile, read_json_object(folder / VIEW), VIEW, hint, "view_file_invalid")

"""service/example: the page's finished example, a result reduced to what the page shows."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path

from PIL import Image

from biresnerf.data.show.history import HISTORY
from biresnerf.data.show.view_file import ShownView, read_view_file, write_view_file

DOWNLOADS = ("transforms.json",)  # beside poses.json and the model
MODEL, MODEL_ARCHIVE = "colmap/sparse/0", "colmap.zip"
UNSEEN, UNSEEN_SIDE = "unseen", 320  # px
SHOWN, QUALITY = 4, 85  # views, and JPEG quality of their pictures


def keep_example(result: Path, example: Path) -> None:
    """Replace the files in ``example`` by those of a result that the page shows, with small pictures."""
    for old in example.glob("*"):
        if old.is_dir() and old.name != UNSEEN:
            shutil.rmtree(old)
        elif old.is_file():
            old.unlink()
    view = read_view_file(result)
    sheet = [view.contact_sheet.file] if view.contact_sheet else []
    for name in (
        view.poses,
        *DOWNLOADS,
        "report.json",
        HISTORY,
        *sheet,
        *([view.orbit] if view.orbit else []),
        *(points.file for points in view.points),
    ):
        (example / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(result / name, example / name)
    _keep_model(result, example / MODEL_ARCHIVE)
    views = tuple(_with_small_pictures(one, result, example) for one in view.views[:SHOWN])
    write_view_file(view.model_copy(update={"views": views}), example)


def _keep_model(result: Path, archive: Path) -> None:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for file in sorted((result / MODEL).iterdir()):
            packed.write(file, file.relative_to(result))


def keep_unseen(pictures: Mapping[str, Image.Image], example: Path) -> None:
    """Store named pictures of one unseen view, for users who have no job yet."""
    (example / UNSEEN).mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        small = picture.resize((UNSEEN_SIDE, UNSEEN_SIDE), Image.Resampling.LANCZOS)
        small.save(example / UNSEEN / f"{name}.jpg", quality=QUALITY, optimize=True)


def _with_small_pictures(view: ShownView, result: Path, example: Path) -> ShownView:
    names = {}
    for kind, file in view.pictures.files().items():
        target = (example / file).with_suffix(".jpg")
        target.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(result / file) as picture:
            picture.convert("RGB").save(target, quality=QUALITY, optimize=True)
        names[kind] = target.relative_to(example).as_posix()
    return view.model_copy(update={"pictures": view.pictures.model_copy(update=names)})

"""One photo of a checked dataset, or its mask, as a picture for pages.

A child program draws it on request: `python -m service.intake.photo_pictures`.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from biresnerf import __version__
from biresnerf.frozen_model import FrozenModel
from biresnerf.wire.datasets import CheckedCamera, CheckedPhoto, PhotoList
from service.http.access import Caller
from service.intake.sandboxed_child import Limits, run_child, run_confined
from workers.process.locked_folders import locked_folder
from workers.records import PHOTO_LIST, DatasetFile
from workers.settings.errors import NotFound

PictureName = Literal["picture.jpg", "mask.png"]
LONG_SIDE_PX = 1280
_FILES = "files"
_QUALITY = 92  # of JPEG without chroma subsampling: areas are selected by colour
_SECONDS, _FILE_BYTES = 60.0, 16 * 2**20


class DrawRequest(FrozenModel):
    """What to draw, and the folder for it; its ``files`` holds the photo's files at their paths."""

    folder: Path
    photo: CheckedPhoto
    camera: CheckedCamera
    name: PictureName


@dataclass(frozen=True)
class Picture:
    """A picture that is drawn on demand; its files are not read before."""

    files: tuple[DatasetFile, ...]
    photo: CheckedPhoto
    camera: CheckedCamera
    name: PictureName

    @property
    def etag(self) -> str:
        """Changes with the files, with what is drawn of them, and with the program's version."""
        sources = [file.sha256 for file in self.files]
        drawn = [self.photo.model_dump_json(), self.camera.model_dump_json(), self.name, __version__]
        return f'"{hashlib.sha256(json.dumps(sources + drawn).encode()).hexdigest()[:32]}"'

    async def drawn(self, caller: Caller) -> bytes:
        """The picture; raises `ProblemError` (``validation_timeout``, ``validation_resources``)."""
        service = caller.service
        async with service.decoding.turn(caller.tenant), locked_folder(service.staging_dir) as folder:
            sources = [(file.key, file.path) for file in self.files]
            await service.stores.files.stage(sources, folder / _FILES)
            request = DrawRequest(folder=folder, photo=self.photo, camera=self.camera, name=self.name)
            memory = service.memory.picture
            limits = Limits(seconds=_SECONDS, memory_bytes=memory, file_bytes=_FILE_BYTES)
            await run_confined("service.intake.photo_pictures", request, limits)
            return (folder / self.name).read_bytes()


async def photo_picture(caller: Caller, dataset_id: str, number: int, name: PictureName) -> Picture:
    """The photo with this number, oriented as its pose assumes, or its mask: same size, white where pixels count.

    Raises `NotFound`: there is no such photo, or no mask, or it is a frame of a video.
    """
    listed = PhotoList.model_validate_json(await caller.datasets.shown(dataset_id, PHOTO_LIST))
    photo = listed.photos[number] if number < len(listed.photos) else None
    if photo is None or photo.path is None or photo.mask is None:
        raise NotFound(f"Dataset {dataset_id} has no file of photo {number}.")
    if name == "mask.png" and not photo.masked:
        raise NotFound(f"Photo {number} of dataset {dataset_id} has no mask.")
    wanted = (photo.path, photo.mask.path) if photo.masked else (photo.path,)
    files = tuple([await caller.datasets.file(dataset_id, path) for path in wanted])
    return Picture(files, photo, listed.cameras[photo.camera], name)


def draw(request: DrawRequest) -> dict[str, Any]:
    """Writes the picture into the folder."""
    from PIL import Image

    from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
    from biresnerf.data.photos.images import load_images
    from biresnerf.geometry.camera.camera_models import Camera

    files, photo, lens = request.folder / _FILES, request.photo, request.camera
    masked = photo.mask if photo.masked else None
    frame = Frame(
        photo.name,
        files / str(photo.path),
        camera=0,
        world_from_cam=None,
        pose_source=None,
        mask=files / masked.path if masked else None,
        orientation=photo.orientation,
        mask_inverted=masked is not None and masked.inverted,
    )
    # Without skew: the mask belongs to the photo before it is straightened.
    camera = Camera(lens.model, lens.width, lens.height, lens.params)
    images = load_images(Dataset(files, (camera,), (frame,), SourceFormat("images")), LONG_SIDE_PX)
    shown = images.counts_image(0) if request.name == "mask.png" else images.image(0)
    assert shown is not None, "only masks of masked photos are asked for"
    Image.fromarray(shown).save(request.folder / request.name, quality=_QUALITY, subsampling=0)
    return {}


if __name__ == "__main__":
    run_child(lambda request: draw(DrawRequest.model_validate(request)))

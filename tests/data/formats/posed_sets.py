"""Sets with photos on disk for readers: reading must return the poses and lenses that the file was made from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.result_formats import formats_given_back
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet
from tests.data.formats.random_sets import random_result
from tests.data.formats.readers import ours, seen_points
from tests.data.scenes import write_image


def result_with_photos(folder: Path, model: str, *, several: bool = False, seed: int = 21) -> RefinedSet:
    """A random result of five images, whose photos lie in ``folder`` under the names that it has."""
    refined = random_result(seed, model=model, several=several)
    write_photos(folder, refined)
    return refined


def write_photos(folder: Path, refined: RefinedSet) -> None:
    """A small picture under the name of each image."""
    for index, image in enumerate(refined.images):
        camera = refined.camera_of(index)
        write_image(folder / image.file_name, index, (camera.width, camera.height))


def write_plain_photos(folder: Path, names: Iterable[str], size: tuple[int, int] = (640, 480)) -> None:
    """A black picture under each name, for real files whose photos are not at hand."""
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", size).save(path)


def renamed(refined: RefinedSet, names: list[str]) -> RefinedSet:
    """The same with other names of the files."""
    images = [replace(image, file_name=name) for image, name in zip(refined.images, names, strict=True)]
    return replace(refined, images=tuple(images))


def assert_reads_as(dataset: Dataset, refined: RefinedSet, dialect: str, pixels: float = 1e-6) -> None:
    """The set has the result's images, poses (to 1e-9) and lenses (points are seen at the same ``pixels``)."""
    assert dataset.source.dialect == dialect
    own = (dialect,) if dialect in ALL_CODECS and ALL_CODECS[dialect].write is not None else ()
    assert formats_given_back(dataset) == own
    there = {PurePosixPath(name).name: index for index, name in enumerate(dataset.file_names)}
    assert len(there) == len(dataset) == len(refined)
    for index, image in enumerate(refined.images):
        frame = dataset.frames[there[PurePosixPath(image.file_name).name]]
        assert frame.world_from_cam is not None, frame.name
        np.testing.assert_allclose(frame.world_from_cam, refined.world_from_cam[index], rtol=0, atol=1e-9)
        read = replace(refined, cameras=dataset.cameras, images=(replace(image, camera=frame.camera),))
        points = seen_points(refined, index)
        assert np.abs(ours(read, 0, points) - ours(refined, index, points)).max() < pixels

"""Runs COLMAP on a folder of images, in a process of its own: ``python -P colmap_child.py REQUEST.json``.

REQUEST.json names the images, the work folder and where the answer goes. pycolmap is kept out of every other
process: its crashes end this one only, and time limits and cancelling work by ending this process.
"""

from __future__ import annotations

import json
import sys

# pycolmap's wheels export another zlib; Python's own must be bound first, or PNG and gzip corrupt the heap.
import zlib  # noqa: F401
from pathlib import Path
from typing import Any

MAX_IMAGE_SIZE = 1600  # long side (px) at which features are found; more costs time and adds little
SEQUENTIAL_OVERLAP = 12  # neighbours that each image is matched with, where all pairs would be too many


def main(request_path: Path) -> None:
    """Features, matches, incremental mapping; writes the largest model found to the request's ``answer``."""
    import pycolmap

    request: dict[str, Any] = json.loads(request_path.read_text("utf-8"))
    work = Path(request["work"])
    database, images = work / "database.db", Path(request["root"])
    pycolmap.set_random_seed(request["seed"])

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = MAX_IMAGE_SIZE
    mode = pycolmap.CameraMode.PER_IMAGE if request["camera_per_image"] else pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, images, image_names=request["names"], camera_mode=mode, reader_options=reader,
        extraction_options=extraction,
    )  # fmt: skip
    if request["sequential"]:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = SEQUENTIAL_OVERLAP
        pycolmap.match_sequential(database, pairing_options=pairing)
    else:
        pycolmap.match_exhaustive(database)

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.random_seed = request["seed"]
    (work / "sparse").mkdir()
    models = pycolmap.incremental_mapping(database, images, work / "sparse", options)
    answer = Path(request["answer"])
    answer.write_text(json.dumps(describe_largest(models)), "utf-8")


def describe_largest(models: dict[int, Any]) -> dict[str, Any]:
    """Cameras and poses of the model with most images, and the sizes of all models."""
    ordered = sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
    if not ordered:
        return {"cameras": {}, "images": [], "sizes": []}
    best = ordered[0]
    cameras = {
        str(number): {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
        }
        for number, camera in best.cameras.items()
    }
    images = []
    for image in best.images.values():
        if image.has_pose:
            images.append(
                {
                    "name": image.name,
                    "camera": str(image.camera_id),
                    "cam_from_world": image.cam_from_world().matrix().tolist(),
                }
            )
    return {"cameras": cameras, "images": images, "sizes": [model.num_reg_images() for model in ordered]}


if __name__ == "__main__":
    main(Path(sys.argv[1]))

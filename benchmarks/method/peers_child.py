"""COLMAP with its own options, for `benchmarks.method.peers`: ``python -m benchmarks.method.peers_child REQUEST.json``.

pycolmap is loaded only in this process, as in `biresnerf.data.seeding.colmap_child`. All options are COLMAP's defaults,
except for the lens, which is given and fixed.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from biresnerf.data.seeding.colmap_child import (
    DATABASE,
    camera_numbers,
    describe,
    extract_features,
    import_images,
)
from biresnerf.data.seeding.colmap_pairs import matched_pairs, write_position_priors


def match(request: dict[str, Any]) -> dict[str, Any]:
    """SIFT of all photos, matches of all pairs; returns the seconds of both, and the database's camera ids."""
    import pycolmap

    database, photos = Path(request["work"], DATABASE), Path(request["root"])
    began = time.monotonic()
    import_images(request, database, photos)
    extract_features(request, database, photos, pycolmap.FeatureExtractionOptions())
    extracted = time.monotonic()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request["seed"]
    pycolmap.match_exhaustive(database, verification_options=verification)
    return {
        "numbers": camera_numbers(request, database),
        "pairs": len(matched_pairs(database)),
        "features_s": extracted - began,
        "matching_s": time.monotonic() - extracted,
    }


def place(request: dict[str, Any]) -> dict[str, Any]:
    """The largest model of one mapper, as `read_mapping` reads it, and how long it took."""
    import pycolmap

    mapper, guided = request["mapper"], request["priors"]
    work = Path(request["work"], f"{mapper}{'-priors' * guided}")
    work.mkdir()
    database = work / DATABASE
    shutil.copyfile(Path(request["work"], DATABASE), database)
    if guided:
        write_position_priors(database, request["cam_from_world"], request["position_deviation"])
    map_all, options = (
        (pycolmap.global_mapping, _global_options())
        if mapper == "global"
        else (pycolmap.incremental_mapping, _incremental_options(request["numbers"], guided))
    )
    options.random_seed = options.mapper.random_seed = request["seed"]
    began = time.monotonic()
    models = map_all(database, request["root"], work, options)
    seconds = time.monotonic() - began
    if not models:
        return {"models": [], "matches": [], "seconds": seconds}
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    described = {"mapper": mapper, **describe(best, request["numbers"])}
    return {"models": [described], "matches": [], "seconds": seconds}


def _incremental_options(numbers: list[int], guided: bool) -> Any:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.constant_cameras = set(numbers)
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.use_prior_position = options.use_robust_loss_on_prior_position = guided
    return options


def _global_options() -> Any:
    """pycolmap 4.2 accepts no position priors here; of pose priors, global mapping reads only gravity."""
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = False
    return options


if __name__ == "__main__":
    asked = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    done = {"match": match, "place": place}[asked["step"]](asked)
    Path(asked["answer"]).write_text(json.dumps(done), "utf-8")

"""How many of the pairs of photos that match are tried: ``python -m benchmarks.large.pairs SET... [--photos 150]``.

Each SET holds true poses. All pairs are matched with the product's features; a pair is true if its matches fit one
relative pose whose rotation is within `NEAR_DEG` of the truth's. Prints a JSON line for each rule by which the product
chooses pairs of large sets: how many pairs it tries, the share of the true ones among all that are true, how many true
pairs the poorest photo keeps, and into how many parts the photos fall. Given poses have BARF's noise (0.15).
"""

from __future__ import annotations

import argparse
import json
import tempfile

# pycolmap's wheels export another zlib; Python's own must be bound first, or PNG and gzip corrupt the heap.
import zlib  # noqa: F401
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_distances import nearest_pairs, pose_distances
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.photos.alike.image_likeness import unlikeness
from biresnerf.data.seeding.colmap_child import DATABASE, extract_features, extraction_options, import_images
from biresnerf.data.seeding.colmap_pairs import likeliest_pairs, match_features
from biresnerf.data.seeding.map_images import (
    BY_LIKENESS,
    BY_NAME,
    LIKELIEST,
    NEIGHBOURS,
    lay_out,
    thoroughness,
)
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import rotation_between_deg

NEAR_DEG = 3.0
Pairs = set[tuple[int, int]]


def true_pairs(dataset: Dataset, database: Path) -> Pairs:
    """Pairs whose matches were verified, and turn as the true poses do."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: int(Path(image.name).stem) for image in opened.read_all_images()}
        verified = list(zip(*opened.read_two_view_geometries(), strict=True))
    rotation, found = dataset.world_from_cam[:, :3, :3], set()
    for pair, geometry in verified:
        a, b = (names[image] for image in pycolmap.pair_id_to_image_pair(pair))
        if geometry.cam2_from_cam1 is None:
            continue
        matched = geometry.cam2_from_cam1.rotation.matrix()
        if rotation_between_deg(matched, rotation[b].T @ rotation[a]) < NEAR_DEG:
            found.add((min(a, b), max(a, b)))
    return found


def parts(pairs: Pairs, count: int) -> int:
    """Into how many parts that nothing connects so many photos fall."""
    part = list(range(count))
    for a, b in pairs:
        one, other = part[a], part[b]
        if one != other:
            part = [one if each == other else each for each in part]
    return len(set(part))


def chosen(
    dataset: Dataset, database: Path, request: dict[str, Any], noise: float, seed: int
) -> dict[str, Pairs]:
    """The pairs of each rule."""
    names = [name for camera in request["cameras"] for name in camera["names"]]
    index = {name: int(Path(name).stem) for name in names}
    by_name = {i: name for name, i in index.items()}
    noisy = perturb_poses(dataset.world_from_cam, noise, seed=seed)
    near = nearest_pairs(pose_distances(noisy), len(noisy), NEIGHBOURS)
    listed = [(by_name[a], by_name[b]) for a, b in sorted(near)]
    likeliest = {(index[a], index[b]) for a, b in likeliest_pairs(database, listed, LIKELIEST)}
    order = natural_order(dataset.names)
    neighbours = {
        (min(a, b), max(a, b))
        for step in range(1, BY_NAME + 1)
        for a, b in zip(order, order[step:], strict=False)
    }
    alike = nearest_pairs(unlikeness(dataset), len(dataset), BY_LIKENESS)
    return {
        f"{NEIGHBOURS} nearest by given poses": near,
        f"of these {LIKELIEST} by coarse features": {(min(p), max(p)) for p in likeliest},
        f"{BY_NAME} by name, {BY_LIKENESS} by likeness": neighbours | alike,
    }


def measured(dataset: Dataset, noise: float, seed: int) -> list[dict[str, Any]]:
    count = len(dataset)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        request = {**lay_out(dataset, work), "seed": seed, "threads": -1, "pairs": None}
        tried = count * LIKELIEST
        request |= {**thoroughness(dataset, "full", tried), "likeliest": None}
        database = work / DATABASE
        import_images(request, database, work / "photos")
        extract_features(request, database, work / "photos", extraction_options(request))
        match_features(request, database, work)
        true = true_pairs(dataset, database)
        rows = []
        rules = {"all": set(combinations(range(count), 2)), **chosen(dataset, database, request, noise, seed)}
        for rule, pairs in rules.items():
            kept = pairs & true
            of_photo: NDArray[np.int64] = np.bincount(np.array(list(kept)).reshape(-1), minlength=count)
            rows.append(
                {
                    "set": dataset.root.name,
                    "photos": count,
                    "rule": rule,
                    "pairs": len(pairs),
                    "true": len(kept),
                    "recall": round(len(kept) / max(1, len(true)), 3),
                    "poorest photo": int(of_photo.min()),
                    "parts": parts(kept, count),
                }
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", type=Path, nargs="+")
    parser.add_argument("--photos", type=int, default=150, help="Of each set, the first.")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    for path in asked.sets:
        dataset = read_dataset(path)
        dataset = replace(dataset, frames=dataset.frames[: asked.photos])
        for row in measured(dataset, asked.noise, asked.seed):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()

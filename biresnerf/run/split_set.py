"""A large set refined in parts: the photos of each, and the options of its run."""

from __future__ import annotations

from collections.abc import Sequence

from biresnerf.data.formats.positions.known_distance import KnownDistance
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.part_of_set import without_photos
from biresnerf.data.parts.cut_set import cut_set
from biresnerf.options.refine_options import RefineOptions, parse_options
from biresnerf.refinement.parameters.rigid_bodies import rigid_bodies

# What the whole alone is asked for, or cannot be asked of some of its photos.
OF_THE_WHOLE = ("verdict", "orbit_frames", "exports", "known_distance", "time_budget_s", "leave_out")


def photos_of_parts(dataset: Dataset, options: RefineOptions, most: int) -> tuple[tuple[str, ...], ...]:
    """The names of each part's photos, about ``most`` in each; every photo that is to be used is in one at least.

    Raises:
        InputError: a code of `without_photos` or `cut_set`; or what the whole would be refused for, hours later.
    """
    dataset = without_photos(dataset, options.leave_out, options.photos)
    rigid_bodies(dataset, options.resolved("cpu"))
    KnownDistance.of(options.known_distance, dataset)
    return tuple(tuple(dataset.names[row] for row in rows.tolist()) for rows in cut_set(dataset, most))


def part_options(options: RefineOptions, photos: Sequence[str]) -> RefineOptions:
    """The options of the run that refines a part: those of the whole, without what concerns the whole alone."""
    asked = options.model_dump(exclude_unset=True)
    kept = {name: value for name, value in asked.items() if name not in OF_THE_WHOLE}
    fixed = tuple(name for name in options.fixed if name in set(photos))
    return parse_options(
        {**kept, "photos": tuple(photos), "fixed": fixed, "verdict": False, "orbit_frames": 0}
    )

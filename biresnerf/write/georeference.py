"""Where the returned cameras lie among measured positions: for the report, and as a file for maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.measured_places import PositionPriors
from biresnerf.geometry.earth.geodesy import place_of
from biresnerf.geometry.earth.georeference import Georeference, NoGeoreference, fit_positions
from biresnerf.uncertainty import GeoReference
from biresnerf.write.output_folder import GEOREFERENCE


def write_georeference(
    dataset: Dataset, world_from_cam: NDArray[np.float64], folder: Path
) -> GeoReference | None:
    """Fit the returned poses [n, 4, 4] to the measured positions, and write georeference.json where these tell a frame.

    Returns what the report says of it; None without measured positions.

    Raises:
        InputError: ``positions_invalid``, or a code of `open_image`.
    """
    priors = position_priors(dataset)
    if priors is None:
        return None
    try:
        fit = fit_positions(world_from_cam[priors.rows], priors.positions_m, priors.accuracy_m)
    except NoGeoreference as reason:
        return _reference(priors).model_copy(update={"why_not": str(reason)})
    found = _with_fit(_reference(priors), priors, fit, dataset.names)
    content = found.model_dump(exclude={"why_not"})
    cameras = _cameras(fit, priors, dataset.names, world_from_cam)
    write_json(folder / GEOREFERENCE, {**content, "cameras": cameras}, indent=1)
    return found


def _reference(priors: PositionPriors) -> GeoReference:
    known = priors.accuracy_m[np.isfinite(priors.accuracy_m)]
    latitude, longitude, altitude = priors.origin or (None, None, None)
    return GeoReference(
        source=priors.source,
        images=len(priors.rows),
        epsg=priors.epsg,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        accuracy_m=float(np.median(known)) if len(known) else None,
    )


def _with_fit(
    reference: GeoReference, priors: PositionPriors, fit: Georeference, names: Sequence[str]
) -> GeoReference:
    matrix = np.eye(4)
    matrix[:3, :3] = fit.metres_from_world.scale * fit.metres_from_world.rotation
    matrix[:3, 3] = fit.metres_from_world.translation
    rows = zip(priors.rows.tolist(), fit.residual_m.tolist(), strict=True)
    return GeoReference.model_validate(
        {
            **reference.model_dump(),
            "used": int(fit.used.sum()),
            "doubt": fit.doubt or None,
            "metres_from_world": tuple(map(tuple, matrix.tolist())),
            "residual_m": float(np.median(fit.residual_m[fit.used])),
            "residuals_m": {names[row]: round(residual, 4) for row, residual in rows},
        }
    )


def _cameras(
    fit: Georeference, priors: PositionPriors, names: Sequence[str], world_from_cam: NDArray[np.float64]
) -> list[dict[str, object]]:
    """Each camera's place: latitude, longitude and height, where the positions have them, else in their frame."""
    metres = fit.metres_from_world.apply_to_poses(world_from_cam)[:, :3, 3]
    if priors.origin is None:
        return [{"name": name, "xyz": at} for name, at in zip(names, metres.tolist(), strict=True)]
    places = place_of(metres, np.array(priors.origin)).tolist()
    return [
        {"name": name, "latitude": at[0], "longitude": at[1], "altitude": at[2]}
        for name, at in zip(names, places, strict=True)
    ]

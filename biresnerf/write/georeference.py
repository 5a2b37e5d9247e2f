"""Where the returned cameras lie among measured places: for the report, and as a file for maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.measured_places import ControlPoints, PositionPriors
from biresnerf.data.points.located_points import MOST_FAR_OFF, LocatedPoints, located
from biresnerf.geometry.earth.geodesy import place_of
from biresnerf.geometry.earth.georeference import Georeference, NoGeoreference, fit_positions
from biresnerf.geometry.rigid import motion_of
from biresnerf.geometry.similarity import Similarity
from biresnerf.uncertainty import ControlPoint, ControlReport, GeoReference
from biresnerf.write.output_folder import GEOREFERENCE


def write_georeference(
    dataset: Dataset, world_from_cam: NDArray[np.float64], folder: Path
) -> GeoReference | None:
    """Fit the returned poses [n, 4, 4] to the measured positions, and write georeference.json where these fix a frame.

    Returns what the report says of it; None without measured positions.

    Raises:
        InputError: ``positions_invalid``, or a code of `open_image`.
    """
    priors = position_priors(dataset)
    if priors is None:
        return None
    try:
        fit = fit_positions(
            world_from_cam[priors.rows], priors.positions_m, priors.accuracy_m, priors.rotations
        )
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
    rows = zip(priors.rows.tolist(), fit.residual_m.tolist(), strict=True)
    return GeoReference.model_validate(
        {
            **reference.model_dump(),
            "used": int(fit.used.sum()),
            "doubt": fit.doubt or None,
            "metres_from_world": _matrix(fit.metres_from_world),
            "residual_m": float(np.median(fit.residual_m[fit.used])),
            "residuals_m": {names[row]: round(residual, 4) for row, residual in rows},
        }
    )


def control_report(dataset: Dataset, world_from_cam: NDArray[np.float64]) -> ControlReport | None:
    """Control and check points at the returned poses [n, 4, 4] and lenses; None without any."""
    points = dataset.control
    if points is None:
        return None
    report = ControlReport(source=points.source, epsg=points.epsg, origin=points.origin)
    try:
        found = located(points, world_from_cam, [dataset.camera_of(i) for i in range(len(dataset))])
    except NoGeoreference as reason:
        doubt = f"{points.source} is not used: {reason}."
        return report.model_copy(update={"why_not": str(reason), "doubt": doubt})
    images, square = np.bincount(points.point), (found.error_m**2).sum(1)
    rows = zip(points.names, points.check, images, found.error_m, found.error_px, found.far_off, strict=True)
    each = tuple(
        ControlPoint(
            name=name,
            check=bool(check),
            images=int(count),
            error_m=tuple(error.tolist()),
            error_px=float(px),
            far_off=bool(far),
        )
        for name, check, count, error, px, far in rows
    )
    figures: dict[str, float | None] = {}
    for kind, chosen in (("control", ~points.check), ("check", points.check)):
        for unit, squares in (("m", square), ("px", found.error_px**2)):
            figures[f"{kind}_{unit}"] = float(squares[chosen].mean() ** 0.5) if chosen.any() else None
    return report.model_copy(
        update={
            "points": each,
            "metres_from_world": _matrix(found.metres_from_world),
            "doubt": _far_off(points, found) or None,
            **figures,
        }
    )


def _far_off(points: ControlPoints, found: LocatedPoints) -> str:
    """Names the points that contradict the photos, with their distances; empty where none does."""
    if not found.far_off.any():
        return ""
    apart = np.linalg.norm(found.error_m, axis=1)
    named = ", ".join(f"{points.names[i]} by {apart[i]:.2f} m" for i in np.flatnonzero(found.far_off))
    others = apart[~found.far_off]
    rest = f" (the others by {np.median(others):.2f} m, median)" if len(others) else ""
    doubt = f"{points.source}: points are not where the photos show them: {named}{rest}."
    if found.far_off[~points.check].mean() > MOST_FAR_OFF:
        return f"{doubt} With so many off, none is believed: the frame may be wrong, or x and y swapped."
    return f"{doubt} Check their coordinates and marks."


def _matrix(similarity: Similarity) -> tuple[tuple[float, ...], ...]:
    return tuple(
        map(tuple, motion_of(similarity.scale * similarity.rotation, similarity.translation).tolist())
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

"""The set's cameras before and after refinement, and how well their focal lengths are known."""

from __future__ import annotations

from biresnerf.data.model.dataset import Dataset
from biresnerf.refinement.parameters.intrinsics_parameters import FocalCertainty, IntrinsicsParameters
from biresnerf.report import CameraReport


def camera_reports(dataset: Dataset, lenses: IntrinsicsParameters) -> tuple[CameraReport, ...]:
    """The set's cameras before and after refinement."""
    used = [frame.camera for frame in dataset.frames]
    after, parts = lenses.refined(dataset).cameras, lenses.refined_parts
    return tuple(
        CameraReport(
            model=old.model,
            width=old.width,
            height=old.height,
            source=dataset.source_of_intrinsics(i),
            refined=parts[i],
            images=used.count(i),
            params_before=old.params,
            params_after=new.params,
            focal_deviation_percent=_percent(lenses.certainty[i]),
            observable=None if (known := lenses.certainty[i]) is None else known.observable,
        )
        for i, (old, new) in enumerate(zip(dataset.cameras, after, strict=True))
    )


def _percent(known: FocalCertainty | None) -> float | None:
    return None if known is None or known.deviation is None else 100 * known.deviation


def focal_warnings(dataset: Dataset, lenses: IntrinsicsParameters) -> tuple[str, ...]:
    """Of focal lengths that were given and kept, although the evidence clearly prefers others."""
    found = []
    for i, known in enumerate(lenses.certainty):
        if known is None or known.contradicts is None or known.deviation is None:
            continue
        longer = "longer" if known.contradicts > 1 else "shorter"
        name = next(frame.name for frame in dataset.frames if frame.camera == i)
        found.append(
            f"Feature matches fit better with a focal length {abs(known.contradicts - 1):.1%} {longer} than given for "
            f"{name} and the images that share its camera (standard deviation {known.deviation:.2%}). It was kept; "
            "refine_intrinsics=focal has it refined."
        )
    return tuple(found)

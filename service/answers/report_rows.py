"""The images of a report as rows that can be sorted."""

from __future__ import annotations

from typing import Any

from biresnerf.wire.results import ImageList, ImageRow


def image_rows(report: dict[str, Any], column: str, *, descending: bool, limit: int) -> ImageList:
    """The rows by a column of `IMAGE_COLUMNS`, or in the set's order; what is unknown comes last."""
    rows = [_row(image) for image in report["images"]]
    if column:
        known = [row for row in rows if getattr(row, column) is not None]
        known.sort(key=lambda row: getattr(row, column), reverse=descending)
        rows = known + [row for row in rows if getattr(row, column) is None]
    return ImageList(partial=report["state"] == "partial", items=rows[:limit])


def _row(image: dict[str, Any]) -> ImageRow:
    before, after = image.get("trial_psnr_before"), image.get("trial_psnr_after")
    gain = after - before if before is not None and after is not None else None
    return ImageRow.model_validate({**image, "delta_psnr": gain})

"""The battery's table, in Markdown."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]
HEADING = (
    "set", "photos", "COLMAP alone", "photos alone", "noisy poses", "seconds", "warnings",
)  # fmt: skip


def table(rows: list[Row]) -> str:
    """A line for each set."""
    lines = [HEADING, ("---",) * len(HEADING), *(_line(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _line(row: Row) -> tuple[str, ...]:
    width, height = row["size"]
    runs = [row.get(name) for name in ("alone", "noisy")]
    warnings = [str(len(run["warnings"])) if run and "warnings" in run else "-" for run in runs]
    seconds = [str(run.get("seconds", "-")) if run else "-" for run in runs]
    return (
        f"{row['set']}: {row['kind']}",
        f"{row['photos']} of {width} x {height}",
        _placed(row.get("peer"), row["photos"]),
        _placed(row.get("alone"), row["photos"]),
        _noisy(row),
        ", ".join(seconds),
        ", ".join(warnings),
    )


def _placed(run: Row | None, count: int) -> str:
    """Photos placed, with those of stated accuracy for the product; the fit of matches and GPS; the verdict."""
    if run is None:
        return "-"
    if "error" in run:
        return f"failed: {run['error'].splitlines()[-1][:80]}"
    placed = f"{run['known']} of {count} known" if "known" in run else f"{run['placed']} of {count}"
    return "; ".join([placed, *_figures(run)])


def _noisy(row: Row) -> str:
    run = row.get("noisy")
    if run is None:
        return "-"
    if "error" in run or "deg" not in run:
        return _placed(run, row["photos"])
    before = row["given"]["own_frame_deg"]
    return f"{before:.1f}° -> {run['deg']:.2f}°, own frame {run['own_frame_deg']:.2f}°; " + "; ".join(
        _figures(run)
    )


def _figures(run: Row) -> list[str]:
    figures = []
    if run.get("epipolar_px") is not None:
        figures.append(f"{run['epipolar_px']:.2f} px")
    if run.get("gps_m") is not None:
        figures.append(f"{run['gps_m']:.1f} m")
    if run.get("verdict"):
        figures.append(run["verdict"].replace("_", " "))
    return figures

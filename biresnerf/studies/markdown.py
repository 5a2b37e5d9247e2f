"""The tables of a comparison as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from biresnerf.studies.tables import METRICS, Difference, Tables

_TITLES = {metric.key: metric for metric in METRICS}


def as_markdown(tables: Tables) -> str:
    """All tables, one after the other; columns without any value are left out."""
    parts = [_rows(tables), _summaries(tables), _differences(tables.differences), _variants(tables)]
    if tables.failures:
        parts.append(_failures(tables))
    if tables.notes:
        parts.append("\n".join(f"- {note}" for note in tables.notes))
    parts.append(f"Measured on {tables.machine}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def _rows(tables: Tables) -> str:
    known = [m for m in METRICS if any(row.values[m.key] is not None for row in tables.rows)]
    head = ["scene", "start", "variant", *(metric.title for metric in known), "runs"]
    lines = []
    for row in tables.rows:
        runs = f"{len(row.seeds)}" + (f" ({row.failed} failed)" if row.failed else "")
        cells = [_number(row.values[metric.key], metric.digits) for metric in known]
        lines.append([row.scene, row.start, row.variant, *cells, runs])
    return "## Per scene\n\n" + _table(head, lines)


def _summaries(tables: Tables) -> str:
    if not tables.summaries:
        return ""
    known = [m for m in METRICS if any(s.mean[m.key] is not None for s in tables.summaries)]
    head = ["start", "variant", "over scenes", *(metric.title for metric in known)]
    lines = []
    for summary in tables.summaries:
        for name, values in (("mean", summary.mean), ("median", summary.median)):
            cells = [_number(values[metric.key], metric.digits) for metric in known]
            lines.append([summary.start, summary.variant, f"{name} of {summary.scenes}", *cells])
    return "## Over scenes\n\n" + _table(head, lines)


def _differences(differences: Sequence[Difference]) -> str:
    if not differences:
        return ""
    head = ["metric", "other - first", "median difference", "n", "differing", "W", "p"]
    lines = []
    for item in differences:
        metric, test = _TITLES[item.metric], item.test
        lines.append(
            [
                metric.title,
                f"{item.other} - {item.first}",
                f"{test.median_difference:+.{metric.digits}f}",
                str(test.pairs),
                str(test.differing),
                _number(test.statistic, 1),
                _number(test.p_value, 4),
            ]
        )
    title = "## Wilcoxon signed-rank test, two-sided, paired by scene, start and seed"
    return f"{title}\n\n" + _table(head, lines)


def _variants(tables: Tables) -> str:
    def as_text(settings: dict[str, object]) -> str:
        return " ".join(f"{key}={value}" for key, value in settings.items())

    lines = [[name, as_text(settings) or "as shared"] for name, settings in tables.variants.items()]
    shared = as_text(tables.settings)
    return (
        "## Variants\n\n" + (f"All: {shared}\n\n" if shared else "") + _table(["variant", "options"], lines)
    )


def _failures(tables: Tables) -> str:
    lines = [
        f"- {item.scene}, {item.start}, seed {item.seed}, {item.variant}: {item.error.splitlines()[0]}: "
        f"{item.error.splitlines()[-1]}"
        for item in tables.failures
    ]
    return "## Failures\n\n" + "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)

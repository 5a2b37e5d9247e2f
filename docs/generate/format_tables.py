"""The tables of formats in docs/formats.md and the page's lists of them, from the formats' declarations."""

from __future__ import annotations

import json
from pathlib import Path

from biresnerf.options.formats import Format, Loss, Need, formats
from docs.generate.markdown import DASH, table

_END = "<!-- end -->"
_LOSSES: dict[Loss, str] = {
    "poses": "poses",
    "names": "names: rows are in the order of the files' names",
    "lenses": "lenses",
    "some lenses": "two focal lengths, a principal point off the centre, lenses other than [these](#camera-models)",
    "distortion": "any distortion",
    "rigs": "rigs and features",
    "points": "points",
    "mask paths": "paths of masks",
    "masks": "masks",
}
_NEEDS: dict[Need, str] = {
    "photos": "the input's photos",
    "images folder": "photos directly in `images/`, where `convert` puts them",
    "lens file": "`camera.json` beside it for the lens",
    "bounds": "depth bounds",
    "input": "the input's own keys",
}


def format_page(path: Path) -> str:
    """docs/formats.md with its generated tables as they should be now."""
    text = path.read_text("utf-8")
    for name, content in (("formats read", _read_table()), ("formats written", _write_table())):
        start = f"<!-- {name}: written by `make docs` -->\n\n"
        before, rest = text.split(start)
        text = before + start + content + "\n" + rest[rest.index(_END) :]
    return text


def _read_table() -> str:
    rows = [
        (
            one.title,
            ", ".join("the folder itself" if name == "." else f"`{name}`" for name in one.found_as),
            one.gives,
            f"`{_folder_of(one)}`",
            one.checked_against,
        )
        for one in formats().values()
        if one.found_as
    ]
    rows.append(("images alone", "the folder itself, `images/`", "sizes, EXIF", "`data/photos`", ""))
    return table(("format", "found as", "what it gives", "code", "checked against"), rows)


def _folder_of(one: Format) -> str:
    path = one.module.removeprefix("biresnerf.").replace(".", "/")
    return path.removesuffix("/format") if path.endswith("/format") else f"{path}.py"


def _write_table() -> str:
    rows = []
    for one in formats().values():
        if not (one.in_set or one.in_result):
            continue
        when = "always" if one.always else "on request" if one.on_request else "where the input has it"
        lost = [_LOSSES[loss] for loss in one.loses] + ([one.lacks] if one.lacks else [])
        rows.append(
            (
                f"`{one.name}`",
                f"`{one.in_result}`",
                when,
                f"`{one.in_set}`",
                one.heading.removeprefix("For "),
                ", ".join(_NEEDS[need] for need in one.needs) or DASH,
                "; ".join(lost) or DASH,
            )
        )
    head = ("format", "in a result", "written", "by `convert`", "for", "needs", "cannot hold")
    return table(head, rows)


def page_formats() -> str:
    """What the web page shows of formats: service/web/formats.json."""
    downloads = [
        {
            "name": one.heading,
            "words": one.hint,
            "files": one.downloads or one.in_result,
            **({"exported": one.name} if one.on_request else {}),
        }
        for one in formats().values()
        if one.in_result
    ]
    titles = ", ".join(one.title for one in formats().values() if one.found_as)
    return json.dumps({"read": titles, "results": downloads}, indent=1, ensure_ascii=False) + "\n"

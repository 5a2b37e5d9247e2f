"""The formats' list and table in docs/formats.md, and the web page's lists, from the formats' declarations."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

from biresnerf.options.formats import Format, Loss, Need, formats
from docs.generate.markdown import DASH, table

_TESTS = Path(__file__).resolve().parents[2] / "tests"
_NAMES = {"bpy": "Blender", "gaussian-splatting": "3D Gaussian Splatting", "open3d": "Open3D"}
_END = "<!-- end -->"
_USUAL = "poses and lenses"  # what a format gives unless the page says otherwise
_MADE_FROM = (
    "its ",
    "their ",
    "the programs' ",
)  # the source, manual or writer of the format: the page mentions these once for all
_RARE: dict[Loss, str] = {  # the sentence below the table names the formats that hold them
    "rigs": "rigs",
    "mask paths": "paths of masks",
}
_LOSSES: dict[Loss, str] = {
    "poses": "poses",
    "names": "names",
    "lenses": "lenses",
    "some lenses": "[other lenses](#camera-models)",
    "distortion": "distortion",
    "points": "points",
    "masks": "masks",
}
_NEEDS: dict[Need, str] = {
    "photos": "the photos",
    "images folder": "photos directly in `images/`",
    "lens file": "`camera.json`",
    "bounds": "depth bounds",
    "input": "the input's keys",
}


def format_page(path: Path) -> str:
    """docs/formats.md with its generated parts up to date."""
    text = path.read_text("utf-8")
    tables = {
        "formats read": _read_list(),
        "formats written": _write_table(),
    }
    for name, content in tables.items():
        start = f"<!-- {name}: written by `make docs` -->\n\n"
        before, rest = text.split(start)
        text = before + start + content + "\n" + rest[rest.index(_END) :]
    return text


def _read_list() -> str:
    rows = [_reading(one) for one in formats().values() if one.found_as]
    return "\n".join([*rows, "- **images alone**: sizes, EXIF"]) + "\n"


def _reading(one: Format) -> str:
    """One line of the list: where the format is found, what it gives, and the files that its reader was tested with."""
    names = ", ".join("the folder" if name == "." else f"`{name}`" for name in one.found_as)
    found = "" if one.found_as == (one.title.split()[0],) else f" ({names})"
    gives = f": {one.gives}" if one.gives != _USUAL else ""
    files = "; ".join(part for part in one.checked_against.split("; ") if not part.startswith(_MADE_FROM))
    return f"- **{one.title}**{found}{gives}" + (f" [{files}]" if files else "")


def _readers() -> dict[str, list[str]]:
    """The programs that read each format in tests, from their marks: ``opens(format, by=program)``."""
    folder = _TESTS / "consumers"
    versions = dict(
        re.findall(r"^([\w-]+)==(\S+)", (folder / "requirements.txt").read_text("utf-8"), re.MULTILINE)
    )
    found: dict[str, list[str]] = {}
    for node in ast.walk(ast.parse((folder / "test_consumers.py").read_text("utf-8"))):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "opens"):
            continue
        [name], [by] = node.args, node.keywords
        program = ast.literal_eval(by.value)
        said = f"{_NAMES.get(program, program)} {versions.get(program, '(source)')}"
        programs = found.setdefault(ast.literal_eval(name), [])
        programs += [] if said in programs else [said]
    return found


def _write_table() -> str:
    readers = _readers()
    written = [one for one in formats().values() if one.in_set or one.in_result]
    head = ("format", "file in a result", "cannot hold", "opened by")
    rows = [
        (
            f"`{one.name}`",
            f"`{one.in_result}`"
            + (f" (`convert`: `{one.in_set}`)" if one.in_set != one.in_result else "")
            + (f", needs {', '.join(_NEEDS[need] for need in one.needs)}" if one.needs else ""),
            "; ".join(
                [_LOSSES[loss] for loss in one.loses if loss not in _RARE] + [one.lacks] * bool(one.lacks)
            )
            or DASH,
            ", ".join(readers.get(one.name, [])) or DASH,
        )
        for one in written
    ]
    held = [
        f"{words} ({', '.join(f'`{one.name}`' for one in written if _holds(one, loss))})"
        for loss, words in _RARE.items()
    ]
    always = ", ".join(f"`{one.name}`" for one in written if one.always)
    of_input = ", ".join(f"`{one.name}`" for one in written if not (one.always or one.on_request))
    return (
        f"{table(head, rows)}\nAlways written: {always}. With such an input: {of_input}. Others: on request.\n"
        f"Only some hold {' and '.join(held)}.\n"
    )


def _holds(one: Format, loss: Loss) -> bool:
    """Whether the format keeps this as well as masks and lenses, unlike mere pictures of the set."""
    return loss not in one.loses and not {"masks", "lenses"} & set(one.loses)


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

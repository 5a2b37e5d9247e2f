"""The tables of formats in docs/formats.md and the page's lists of them, from the formats' declarations."""

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
_RARE: dict[Loss, str] = {  # the sentence below the table names the formats that hold them
    "rigs": "rigs",
    "mask paths": "paths of masks",
}
_LOSSES: dict[Loss, str] = {
    "poses": "poses",
    "names": "names: rows follow the order of the files' names",
    "lenses": "lenses",
    "some lenses": "lenses other than [these](#camera-models)",
    "distortion": "distortion",
    "points": "points",
    "masks": "masks",
}
_NEEDS: dict[Need, str] = {
    "photos": "the photos",
    "images folder": "photos directly in `images/`",
    "lens file": "`camera.json` for the lens",
    "bounds": "depth bounds",
    "input": "the input's keys",
}


def format_page(path: Path) -> str:
    """docs/formats.md with its generated tables as they should be now."""
    text = path.read_text("utf-8")
    tables = {
        "formats read": _read_table(),
        "formats written": _write_table(),
    }
    for name, content in tables.items():
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
            one.checked_against,
        )
        for one in formats().values()
        if one.found_as
    ]
    rows.append(("images alone", "the folder itself, `images/`", "sizes, EXIF", ""))
    return table(("format", "found as", "what it gives", "checked against"), rows)


def _readers() -> dict[str, list[str]]:
    """By format the programs that read it in tests, as their marks say: ``opens(format, by=program)``."""
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
    head = ("format", "file in a result", "written", "for", "cannot hold", "opened by")
    rows = [
        (
            f"`{one.name}`",
            f"`{one.in_result}`" + (f" (`convert`: `{one.in_set}`)" if one.in_set != one.in_result else ""),
            _when(one),
            one.heading.removeprefix("For "),
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
    return f"{table(head, rows)}\nOnly some hold {' and '.join(held)}.\n"


def _when(one: Format) -> str:
    when = "always" if one.always else "on request" if one.on_request else "where the input has it"
    return when + (f"; needs {', '.join(_NEEDS[need] for need in one.needs)}" if one.needs else "")


def _holds(one: Format, loss: Loss) -> bool:
    """Whether it holds what most formats lose, and is more than a picture of the set."""
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

"""The scripts of examples/ as notebooks, with cells split at ``# %%``; outputs stay while the code is unchanged."""

from __future__ import annotations

import json
import re
from pathlib import Path

_CELL = re.compile(r"^# %%(?P<markdown> \[markdown\])?\n", re.MULTILINE)


def notebook(script: Path) -> str:
    """The script as a notebook of format 4.5; the text before its first cell (the docstring) is left out.

    If the existing notebook has the same code, its outputs are kept.
    """
    text = script.read_text("utf-8")
    marks = list(_CELL.finditer(text))
    ends = [mark.start() for mark in marks[1:]] + [len(text)]
    cells = [
        _cell(index, mark["markdown"] is not None, text[mark.end() : end].strip("\n"))
        for index, (mark, end) in enumerate(zip(marks, ends, strict=True))
    ]
    there = script.with_suffix(".ipynb")
    if there.is_file():
        _keep_outputs(cells, json.loads(there.read_text("utf-8"))["cells"])
    document = {
        "cells": cells,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _keep_outputs(cells: list[dict[str, object]], before: list[dict[str, object]]) -> None:
    """Copy the cells' old outputs, unless the code of any cell has changed."""

    def code(some: list[dict[str, object]]) -> list[object]:
        return [cell["source"] for cell in some if cell["cell_type"] == "code"]

    if code(cells) != code(before):
        return
    ran = iter([cell for cell in before if cell["cell_type"] == "code"])
    for cell in cells:
        if cell["cell_type"] == "code":
            cell.update(
                {key: value for key, value in next(ran).items() if key in ("execution_count", "outputs")}
            )


def _cell(index: int, markdown: bool, text: str) -> dict[str, object]:
    if markdown:
        text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in text.splitlines())
    source = text.splitlines(keepends=True)
    shared = {"id": f"cell-{index}", "metadata": {}, "source": source}
    if markdown:
        return {"cell_type": "markdown", **shared}
    return {"cell_type": "code", "execution_count": None, **shared, "outputs": []}

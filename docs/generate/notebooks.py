"""The walks of examples/ as notebooks: their cells, split at ``# %%``, without outputs."""

from __future__ import annotations

import json
import re
from pathlib import Path

_CELL = re.compile(r"^# %%(?P<markdown> \[markdown\])?\n", re.MULTILINE)


def notebook(script: Path) -> str:
    """The script as a notebook of format 4.5; what stands before its first cell (its docstring) is left out."""
    text = script.read_text("utf-8")
    marks = list(_CELL.finditer(text))
    ends = [mark.start() for mark in marks[1:]] + [len(text)]
    cells = [
        _cell(index, mark["markdown"] is not None, text[mark.end() : end].strip("\n"))
        for index, (mark, end) in enumerate(zip(marks, ends, strict=True))
    ]
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


def _cell(index: int, markdown: bool, text: str) -> dict[str, object]:
    if markdown:
        text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in text.splitlines())
    source = text.splitlines(keepends=True)
    shared = {"id": f"cell-{index}", "metadata": {}, "source": source}
    if markdown:
        return {"cell_type": "markdown", **shared}
    return {"cell_type": "code", "execution_count": None, **shared, "outputs": []}

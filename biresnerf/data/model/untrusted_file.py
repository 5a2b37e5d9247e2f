"""Files of unknown origin: bounded in size, text in UTF-8, numbers finite, JSON without duplicate keys.

XML is bounded, and without entities, so that nothing can expand.
"""

from __future__ import annotations

import csv
import json
import math
import re
import xml.parsers.expat
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from biresnerf.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

# A table's head is one of so many lines, as other things may stand above, and names no more columns.
HEAD_LINES, MOST_COLUMNS = 100, 1000
_MAX_DEPTH, _MAX_ELEMENTS = 50, 500_000  # of XML
MAX_TEXT_BYTES = 64 * 2**20  # some 100 000 frames; a larger file is no pose file


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """The content of ``path``. Raises InputError ``pose_file_invalid`` where it is longer than ``most_bytes``."""
    try:
        size = path.stat().st_size
        if size > most_bytes:
            what = f"{size / 2**20:.0f} MiB is more than a pose file may have ({most_bytes // 2**20} MiB)."
            raise invalid_file(path.name, what, "Leave out what does not describe cameras, or split the set.")
        return path.read_bytes()
    except OSError as error:
        what = f"cannot be read: {error.strerror}."
        raise invalid_file(path.name, what, "Check the path and its permissions.") from None


def read_text(path: Path, most_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of ``path``. Raises InputError ``pose_file_invalid`` where it is none, or longer than ``most_bytes``."""
    try:
        return read_bytes(path, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        hint = "Save it in UTF-8, or export it again."
        raise invalid_file(path.name, "is not UTF-8 text.", hint) from None


def read_words(path: Path) -> list[tuple[str, list[str]]]:
    """The place and the words of each line with content; lines that begin with # are comments.

    Raises:
        InputError: as `read_text` does.
    """
    lines = ((number, line.split()) for number, line in enumerate(read_text(path).splitlines(), start=1))
    return [(f"{path.name} line {n}", words) for n, words in lines if words and not words[0].startswith("#")]


def finite_numbers(words: Sequence[str], where: str, hint: str, *counts: int) -> NDArray[np.float64]:
    """The numbers that ``words`` stand for, as many as one of ``counts`` where these are given.

    Raises:
        InputError: ``pose_file_invalid`` or ``pose_not_finite``.
    """
    try:
        values = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError:
        raise invalid_file(where, "holds a word that is not a number.", hint) from None
    refuse_not_finite(values, where, hint)
    if counts and len(words) not in counts:
        raise invalid_file(where, f"has {len(words)} numbers, not {' or '.join(map(str, counts))}.", hint)
    return values


@dataclass(frozen=True)
class Table:
    """A text table whose head names its columns.

    Attributes:
        head: the place of the line that names the columns.
        columns: where the columns of known meaning are.
        rows: place and cells of those below, stripped; blank lines and comments are left out.
    """

    head: str
    columns: dict[str, int]
    rows: tuple[tuple[str, list[str]], ...]

    def cell(self, row: Sequence[str], meaning: str) -> str:
        """The text of a column; empty where the table or the row lacks it."""
        at = self.columns.get(meaning, len(row))
        return row[at] if at < len(row) else ""

    def numbers(self, row: Sequence[str], meanings: Sequence[str], where: str, hint: str) -> list[float]:
        """The numbers in these columns. Raises InputError as `finite_numbers` does, also for a row that is cut off."""
        if len(row) <= max(self.columns.values()):
            raise invalid_file(where, f"has {len(row)} values, fewer than columns.", hint)
        found: list[float] = finite_numbers([self.cell(row, one) for one in meanings], where, hint).tolist()
        return found


def read_table(
    file: str,
    lines: Sequence[str],
    titles: Mapping[str, Sequence[str]],
    is_head: Callable[[Collection[str]], bool],
) -> Table | None:
    """The table below the first of `HEAD_LINES` that is a head, between commas, semicolons or tabs; None where none is.

    Args:
        file: its name, for messages.
        titles: what columns of a meaning are called, as patterns of small letters and digits, preferred ones first.
        is_head: whether a line is the head, by the meanings that it has columns for.
    """
    for index, line in enumerate(lines[:HEAD_LINES]):
        separator = max(",;\t", key=line.count)
        words = [re.sub(r"[^a-z0-9]", "", word.lower()) for word in line.split(separator)[:MOST_COLUMNS]]
        columns = {
            meaning: at
            for meaning, patterns in titles.items()
            for pattern in reversed(patterns)
            for at in reversed(range(len(words)))
            if re.fullmatch(pattern, words[at])
        }
        if is_head(columns):
            below = [(f"{file} line {n}", one) for n, one in enumerate(lines[index + 1 :], index + 2)]
            below = [(where, one) for where, one in below if one.strip() and not one.startswith("#")]
            rows = csv.reader((one for _, one in below), delimiter=separator)
            told = [
                (where, [cell.strip() for cell in row]) for (where, _), row in zip(below, rows, strict=False)
            ]
            return Table(f"{file} line {index + 1}", columns, tuple(told))
    return None


def invalid_file(where: str, what: str, hint: str) -> InputError:
    """The error for a pose file of which ``what`` is wrong at ``where``."""
    return InputError("pose_file_invalid", what, where=where, hint=hint)


def refuse_not_finite(values: NDArray[np.float64], where: str, hint: str) -> None:
    """Raises InputError ``pose_not_finite`` unless all of ``values``, at ``where``, are finite."""
    if not np.isfinite(values).all():
        raise InputError("pose_not_finite", "NaN or an infinite number.", where=where, hint=hint)


class _DuplicateKeyError(ValueError):
    pass


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            beside = result.get("file_path")
            raise _DuplicateKeyError(
                f"the key {repr(key)[:100]} stands twice in one object"
                + (f" (of {repr(beside)[:100]})." if beside else ".")
            )
        result[key] = value
    return result


def first_non_finite(value: Any) -> str | None:
    """The path (``.frames[3].transform_matrix[0][1]``) of the first NaN or infinite number, or None."""
    if isinstance(value, float):
        return None if math.isfinite(value) else ""
    if isinstance(value, dict):
        for key, item in value.items():
            if (found := first_non_finite(item)) is not None:
                return f".{key}{found}"
    elif isinstance(value, list):
        for index, item in enumerate(value):
            if (found := first_non_finite(item)) is not None:
                return f"[{index}]{found}"
    return None


# A string, which may hold slashes, or a comment. An open one goes on to the end: it is not looked at again.
_STRING_OR_COMMENT = re.compile(r'"(?:\\.|[^"\\])*(?:"|\Z)|//[^\n]*|/\*.*?(?:\*/|\Z)', re.DOTALL)


def _parsed(text: str) -> Any:
    """The JSON value; with comments, which instant-ngp allows, only where it is none without."""
    try:
        return json.loads(text, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        if "//" not in text and "/*" not in text:
            raise
        first = error
    try:
        return json.loads(_STRING_OR_COMMENT.sub(_blank, text), object_pairs_hook=_object)
    except json.JSONDecodeError:
        raise first from None


def _blank(match: re.Match[str]) -> str:
    return match[0] if match[0].startswith('"') else re.sub(r"[^\n]", " ", match[0])


def read_json(path: Path, *, apart: str | None = None) -> Any:
    """The value in the JSON file ``path``.

    Comments (``//`` and ``/* */``) are left out.

    Args:
        apart: a key whose numbers the caller checks with `refuse_non_finite`.

    Raises:
        InputError: ``pose_file_invalid`` for a file that cannot be read, is larger than ``MAX_TEXT_BYTES``,
            is not JSON, has a key twice, or is nested too deeply; ``pose_not_finite`` for NaN and Infinity.
    """
    text = read_text(path)
    try:
        document = _parsed(text)
    except _DuplicateKeyError as error:
        raise invalid_file(path.name, str(error), "Remove one of the two.") from None
    except json.JSONDecodeError as error:
        what = f"not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}."
        raise invalid_file(path.name, what, "The file may be cut off; export or copy it again.") from None
    except RecursionError:
        raise invalid_file(path.name, "nested too deeply.", "Export the poses again.") from None
    except ValueError as error:  # numbers of thousands of digits
        raise invalid_file(path.name, f"not readable: {error}.", "Export the poses again.") from None
    looked_at = document
    if apart is not None and isinstance(document, dict):
        looked_at = {key: value for key, value in document.items() if key != apart}
    refuse_non_finite(looked_at, path.name)
    return document


def read_json_object(path: Path) -> dict[str, Any]:
    """As `read_json`, for a file that must hold an object. Raises InputError ``pose_file_invalid`` for another."""
    document = read_json(path)
    if not isinstance(document, dict):
        what = f"holds a {type(document).__name__}, not an object with `frames`."
        raise invalid_file(
            path.name, what, "Give a transforms.json as nerfstudio, instant-ngp or Blender write it."
        )
    return document


def refuse_non_finite(value: Any, file: str, place: str = "") -> None:
    """Raises InputError ``pose_not_finite`` for NaN and infinite numbers in ``value``, which lies at ``place``."""
    found = first_non_finite(value)
    if found is not None:
        raise InputError(
            "pose_not_finite",
            "NaN or an infinite number.",
            where=f"{file} {(place + found).removeprefix('.')[:300]}",
            hint="Remove the frame, or its transform_matrix, or export it again.",
        )


def checked(model: type[Model], value: object, where: str, hint: str, code: str | None = None) -> Model:
    """A document, or the part of one that is at ``where``, as ``model``.

    Raises:
        InputError: ``code`` with the first wrong field; where left out ``pose_not_finite`` for a number that is not
            finite, else ``pose_file_invalid``.
    """
    try:
        return model.model_validate(value)
    except ValidationError as error:
        first = error.errors()[0]
        not_finite = first["type"] == "finite_number"
        code = code or ("pose_not_finite" if not_finite else "pose_file_invalid")
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(code, f"{first['msg']}.", where=f"{where} {field}".rstrip(), hint=hint) from None


class _TreeBuilder(ElementTree.TreeBuilder):
    """A tree that is neither too deep nor too large."""

    depth = elements = 0

    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        self.depth, self.elements = self.depth + 1, self.elements + 1
        if self.depth > _MAX_DEPTH or self.elements > _MAX_ELEMENTS:
            raise ElementTree.ParseError("nested too deeply, or too long")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)


def read_xml(file: Path, hint: str) -> ElementTree.Element:
    """The root of the XML ``file``. Raises InputError ``pose_file_invalid``, also for document types and entities."""
    text = read_text(file)
    try:
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ElementTree.ParseError("document types and entities are not read")
        return ElementTree.fromstring(text, parser=ElementTree.XMLParser(target=_TreeBuilder()))
    except (ElementTree.ParseError, xml.parsers.expat.ExpatError, ValueError) as error:
        raise invalid_file(file.name, f"is no XML that is read: {error}.", hint) from None

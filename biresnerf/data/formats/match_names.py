"""Names of images as pose files write them, and the image files that they mean."""

from __future__ import annotations

import posixpath
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import PurePosixPath
from typing import TypeAlias

from biresnerf.data.photos.photo_folders import IMAGE_FOLDER

# Ways of matching that deserve no note for a file that names neither folders nor extensions.
EXPECTED = ("without extension", "by file name alone")
_IMAGES = f"{IMAGE_FOLDER}/"


Rule: TypeAlias = tuple[str, Callable[[str], str]]


def match_files(
    names: Sequence[str], files: Sequence[str], rules: Sequence[Rule] | None = None
) -> tuple[dict[str, str], list[str]]:
    """The file that each name means, and notes; names that none, or several, could mean are left out.

    The same path, below images/ or with it; else, where one name and one file alone share it, the same in another
    Unicode form, then the same end of the path (as from another machine), then the same file name in another folder,
    then with letters of another case, then with another extension, then with more zeros before numbers; or by
    ``rules`` instead of these.
    """
    found: dict[str, str] = {}
    free = set(files)
    spellings: tuple[Callable[[str], str], ...] = (
        lambda name: name,
        lambda name: name.replace("\\", "/"),
        lambda name: name.removeprefix(_IMAGES),
        lambda name: _IMAGES + name,
    )
    for key in spellings:
        for name in names:
            if name not in found and key(name) in free:
                found[name] = key(name)
                free.remove(key(name))
    notes = []
    for rule, key in _RULES if rules is None else rules:
        open_names = _unique([name for name in names if name not in found], key)
        taken = set(found.values())
        open_files = _unique([file for file in files if file not in taken], key)
        pairs = {name: open_files[shared] for shared, name in open_names.items() if shared in open_files}
        if pairs:
            example = next(iter(pairs.items()))
            notes.append(f"{len(pairs)} images were found {rule} ({example[0]} is {example[1]})")
        found |= pairs
    return found, notes


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name.replace("\\", "/"))


def _end(parts: int) -> Callable[[str], str]:
    return lambda name: "/".join(_normal(name).split("/")[-parts:])


_OTHER_FORM: Rule = ("by the same name in another Unicode form", _normal)
# For paths of another machine, of which the end alone means something.
ENDS: tuple[Rule, ...] = (
    *((f"by the last {parts} parts of their path", _end(parts)) for parts in (4, 3, 2)),
    ("by file name alone", _end(1)),
)
# For names whose folder means something: train/ is not test/.
SAME_PATH: tuple[Rule, ...] = (
    _OTHER_FORM,
    ("by their path, whatever its case", lambda name: _normal(name).removeprefix("./").casefold()),
    (
        "by their path without extension, whatever its case",
        lambda name: posixpath.splitext(_normal(name).removeprefix("./").casefold())[0],
    ),
)
_RULES: tuple[Rule, ...] = (
    _OTHER_FORM,
    *ENDS,
    ("by file name, whatever its case", lambda name: posixpath.basename(_normal(name)).casefold()),
    ("by file name without extension", lambda name: PurePosixPath(_normal(name)).stem.casefold()),
    ("by path without extension", lambda name: posixpath.splitext(_normal(name))[0]),
    (
        "by file name, with numbers compared as numbers",
        lambda name: re.sub(r"0*(\d+)", r"\1", PurePosixPath(_normal(name)).stem.casefold()),
    ),
)


def _unique(names: Sequence[str], key: Callable[[str], str]) -> dict[str, str]:
    """The names by their key, without those that share one."""
    counts = Counter(map(key, names))
    return {key(name): name for name in names if counts[key(name)] == 1}

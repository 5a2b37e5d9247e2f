"""Which file names clients may send, and which names may stand together in one dataset."""

from __future__ import annotations

import re
import unicodedata

from biresnerf.errors import InputError

# File systems allow 255, and stores append to a name while they write it. Of the 1 024 bytes that a key may have in a
# bucket, some are the folder's.
PART_BYTES_MAX = 240
PATH_BYTES_MAX = 900
DEPTH_MAX = 16
_DRIVE = re.compile(r"^[A-Za-z]:")
_HINT = "Use relative names with forward slashes, such as images/0001.png."
# Device names on Windows, with any extension: such a file cannot be unpacked there.
_DEVICE = re.compile(r"^(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?$", re.IGNORECASE)
# Bidirectional controls: they make a name look like another one.
_TURNS_TEXT = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
# Files that Finder and Explorer create by themselves.
_LITTER = {".ds_store", "thumbs.db", "desktop.ini"}


def checked_path(name: str) -> str:
    """`name` as a safe relative POSIX path (a leading `./` dropped); raises `InputError` ``unsafe_path``.

    Refuses `..`, absolute names, drive letters, backslashes, NUL and control characters, undecodable
    bytes, bidirectional controls, device names, empty parts, parts longer than 240 bytes and nesting
    deeper than 16.
    """
    kept = "/".join(part for part in name.split("/") if part != ".")
    problem = _problem(name, kept)
    if problem:
        raise InputError("unsafe_path", problem, where=_printable(name), hint=_HINT)
    return kept


def _problem(name: str, kept: str) -> str | None:
    """What is wrong with a name; `kept` is the name without parts `.`."""
    parts = kept.split("/")
    # U+FFFD stands where bytes could not be decoded.
    if any(char == "\ufffd" or unicodedata.category(char) in {"Cc", "Cs", "Zl", "Zp"} for char in name):
        return "The name has a control character or bytes that are not text."
    if not _TURNS_TEXT.isdisjoint(name):
        return "The name has a mark that turns the direction of text around."
    if "\\" in name:
        return "The name has a backslash."
    if name.startswith("/"):
        return "The name is absolute."
    if _DRIVE.match(kept):
        return "The name begins with a drive letter."
    if ".." in parts:
        return "The name has a part `..`."
    if "" in parts:
        return "The name has an empty part."
    if any(_DEVICE.match(part) for part in parts):
        return "A part of the name is the name of a device."
    if max(len(part.encode()) for part in parts) > PART_BYTES_MAX:
        return f"A part of the name is longer than {PART_BYTES_MAX} bytes."
    if len(name.encode()) > PATH_BYTES_MAX:
        return f"The name is longer than {PATH_BYTES_MAX} bytes."
    if len(parts) > DEPTH_MAX:
        return f"The name is nested deeper than {DEPTH_MAX} folders."
    return None


def _printable(name: str) -> str:
    """The name for a message: escaped and truncated."""
    return name.encode("unicode_escape").decode()[:300]


def is_litter(path: str) -> bool:
    """Whether the operating system created the file by itself (`__MACOSX/`, `._a.png`, `.DS_Store`)."""
    parts = path.split("/")
    return "__MACOSX" in parts or parts[-1].startswith("._") or parts[-1].lower() in _LITTER


class NameSet:
    """A set of names without conflicts on any file system: no two differ only in case or Unicode form."""

    def __init__(self) -> None:
        self._files: dict[str, str] = {}
        self._folders: dict[str, str] = {}

    def add(self, path: str) -> None:
        """Adds a safe path; raises `InputError` ``name_collision`` if it conflicts with another."""
        parts = path.split("/")
        for depth in range(1, len(parts)):
            folder = "/".join(parts[:depth])
            known = self._folders.setdefault(_key(folder), folder)
            if known != folder:
                raise _collision(path, known)
            if _key(folder) in self._files:
                raise _collision(path, self._files[_key(folder)])
        key = _key(path)
        if key in self._files or key in self._folders:
            raise _collision(path, self._files.get(key) or self._folders[key])
        self._files[key] = path


def _key(path: str) -> str:
    # Casefolding can undo NFC, so normalise on both sides of it (Unicode, definition D146).
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", path).casefold())


def _collision(path: str, other: str) -> InputError:
    return InputError(
        "name_collision",
        f"The name meets another one, {_printable(other)}: they are equal but for case or accents, "
        "the same twice, or a file and a folder at once.",
        where=_printable(path),
        hint="Give every file a name of its own.",
    )

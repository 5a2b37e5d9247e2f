"""The growing log of a job's process, read line by line for those who follow it."""

from __future__ import annotations

from pathlib import Path

LINE_CHARACTERS_MAX = 2000
LINES_AT_ONCE = 500
_READ_BYTES = 2**18


class LogLines:
    """Gives each line of a file once, as soon as it is whole."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._rest = path, 0, b""
        self._lines: list[str] = []

    def fresh(self, *, last: bool) -> list[str]:
        """The next lines, `LINES_AT_ONCE` at most; none if there are no more. ``last``: the file is whole."""
        while len(self._lines) < LINES_AT_ONCE and (read := self._read()):
            *whole, self._rest = (self._rest + read).split(b"\n")
            if len(self._rest) > _READ_BYTES:  # no line at all; its beginning will do
                whole, self._rest = [*whole, self._rest], b""
            self._lines += map(_shown, whole)
        if last and self._rest and len(self._lines) < LINES_AT_ONCE:
            self._lines, self._rest = [*self._lines, _shown(self._rest)], b""
        given, self._lines = self._lines[:LINES_AT_ONCE], self._lines[LINES_AT_ONCE:]
        return given

    def _read(self) -> bytes:
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                read = file.read(_READ_BYTES)
        except FileNotFoundError:
            return b""
        self._offset += len(read)
        return read


def _shown(line: bytes) -> str:
    # A progress bar overwrites itself; what it showed last is the line. The database stores no NUL in text.
    text = line.decode(errors="replace").rstrip("\r").rpartition("\r")[2].replace("\0", "\ufffd")
    return text if len(text) <= LINE_CHARACTERS_MAX else text[: LINE_CHARACTERS_MAX - 1] + "\u2026"

"""Arrays that NumPy saved (npy, npz), of unknown origin.

The header is matched and not evaluated as the Python literal that it is: on hostile headers numpy.load raises more than
ValueError (TokenError, RecursionError, MemoryError), and it allocates before it reads.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.untrusted_file import invalid_file

HEAD_BYTES = 4096
_HEAD = re.compile(
    rb"\{'descr': '([<>|=][a-zA-Z]\d{1,4})', 'fortran_order': (True|False), 'shape': \(([\d, ]{0,100})\),? ?\}[ \n]*"
)
_MOST_OF_ROW = 64 * 2**20
_BROKEN = (
    zipfile.BadZipFile, zlib.error, ValueError, OSError, NotImplementedError, RuntimeError, EOFError
)  # fmt: skip


class _Head(NamedTuple):
    kind: bytes
    order: Literal["F", "C"]
    shape: tuple[int, ...]
    start: int


def _head(content: bytes) -> _Head | None:
    start = {1: 10, 2: 12, 3: 12}.get(content[6] if len(content) > 12 else 0, 0)
    if not content.startswith(b"\x93NUMPY") or not start:
        return None
    length = int.from_bytes(content[8:start], "little")
    match = _HEAD.fullmatch(content[start : start + min(length, HEAD_BYTES)])
    if match is None:
        return None
    shape = tuple(int(word) for word in match[3].replace(b",", b" ").split())
    return _Head(match[1], "F" if match[2] == b"True" else "C", shape, start + length)


def npy_shape(head: bytes) -> tuple[int, ...]:
    """The shape of an array by its first `HEAD_BYTES`; () where these are of no array."""
    found = _head(head)
    return found.shape if found else ()


def npy_numbers(content: bytes, where: str, hint: str) -> NDArray[np.float64]:
    """The floating-point numbers of an npy file. Raises InputError ``pose_file_invalid`` where it holds no such."""
    head = _head(content)
    if head is None or re.fullmatch(rb"<f[248]", head.kind) is None:
        raise invalid_file(where, "is no array of floating-point numbers.", hint)
    dtype, numbers = np.dtype(head.kind.decode()), content[head.start :]
    if len(numbers) != math.prod(head.shape) * dtype.itemsize:
        what = f"has the shape {head.shape} by its header, but its content is shorter or longer."
        raise invalid_file(where, what, hint)
    return np.frombuffer(numbers, dtype).reshape(head.shape, order=head.order).astype(np.float64)


@contextmanager
def _opened(file: Path, hint: str) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(file) as archive:
            yield archive
    except _BROKEN as error:
        raise invalid_file(file.name, f"cannot be read: {error}.", hint) from None


def npz_shapes(file: Path, hint: str) -> dict[str, tuple[int, ...]]:
    """The arrays of an npz file with their shapes. Raises InputError ``pose_file_invalid``."""
    found = {}
    with _opened(file, hint) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as opened:
                found[entry.filename.removesuffix(".npy")] = npy_shape(opened.read(HEAD_BYTES))
    return found


def npz_numbers(
    file: Path, wanted: Callable[[str], bool], most_bytes: int, hint: str
) -> dict[str, NDArray[np.float64]]:
    """The ``wanted`` arrays of an npz file, none of which may be longer than ``most_bytes``.

    Raises:
        InputError: ``pose_file_invalid``.
    """
    found = {}
    with _opened(file, hint) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if not wanted(name):
                continue
            with archive.open(entry) as opened:
                content = opened.read(most_bytes + 1)
            if len(content) > most_bytes:
                raise invalid_file(f"{file.name} {name}", "is too long.", hint)
            found[name] = npy_numbers(content, f"{file.name} {name}", hint)
    return found


def npz_rows(file: Path, name: str, hint: str) -> Iterator[NDArray[np.float64]]:
    """The rows of a float32 array of an npz file, one by one; none of an array of another kind.

    Raises:
        InputError: ``pose_file_invalid``.
    """
    with _opened(file, hint) as archive, archive.open(f"{name}.npy") as opened:
        content = opened.read(HEAD_BYTES)
        head = _head(content)
        if (
            head is None
            or head.kind != b"<f4"
            or head.order != "C"
            or math.prod(head.shape[1:]) > _MOST_OF_ROW
        ):
            return
        size, content = 4 * math.prod(head.shape[1:]), content[head.start :]
        for _ in range(head.shape[0]):
            content += opened.read(size - len(content))
            if len(content) < size:
                raise ValueError("it is cut off")
            yield np.frombuffer(content[:size], np.float32).reshape(head.shape[1:]).astype(np.float64)
            content = content[size:]

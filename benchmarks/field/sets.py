"""The sets of the battery: their sources and the photos used. The photos are not in this repository."""

from __future__ import annotations

import io
import json
import subprocess
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_name("sets.json")


@dataclass(frozen=True)
class FieldSet:
    """One set of the list.

    Attributes:
        name: what the table calls it.
        kind: what is photographed, and with what.
        repository: ``owner/name`` on GitHub.
        commit: the commit whose files are used.
        folder: within the repository.
        licence: of the photos, as far as it is stated.
        photos: names within the folder; a subset where the set is large.
        also: other files of it that belong to these photos, such as poses.
        owner_poses: whether these files hold poses.
        held_back: not examined during development.
    """

    name: str
    kind: str
    repository: str
    commit: str
    folder: str
    licence: str
    photos: tuple[str, ...]
    also: tuple[str, ...] = ()
    owner_poses: bool = False
    held_back: bool = False


def read_sets(path: Path = LIST) -> list[FieldSet]:
    """The list, in its order. Names of photos are one string, separated by spaces."""
    rows: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))
    split = [{key: tuple(row.get(key, "").split()) for key in ("photos", "also")} for row in rows]
    return [FieldSet(**{**row, **names}) for row, names in zip(rows, split, strict=True)]


def lay_out(field_set: FieldSet, data: Path) -> Path:
    """The folder ``data``/sets/NAME with the set's files, taken from a clone once.

    Raises:
        FileNotFoundError: the clone lacks some of them.
    """
    folder = data / "sets" / field_set.name
    wanted = (*field_set.photos, *field_set.also)
    if all((folder / name).is_file() for name in wanted):
        return folder
    paths = [str(Path(field_set.folder, name)) for name in wanted]
    taken = subprocess.run(
        ["git", "-C", str(clone_of(field_set, data)), "archive", field_set.commit, "--", *paths],
        capture_output=True,
        check=False,
    )
    if taken.returncode != 0:
        said = taken.stderr.decode(errors="replace").strip()
        raise FileNotFoundError(f"{field_set.name}: its clone lacks some files: {said}")
    with tarfile.open(fileobj=io.BytesIO(taken.stdout)) as archive:
        for member in archive.getmembers():
            content = archive.extractfile(member)
            if content is not None:
                to = folder / Path(member.name).relative_to(field_set.folder)
                to.parent.mkdir(parents=True, exist_ok=True)
                to.write_bytes(content.read())
    return folder


def clone_of(field_set: FieldSet, data: Path) -> Path:
    """The clone in ``data`` named NAME, OWNER+NAME or OWNER/NAME; else a new one from GitHub."""
    owner, name = field_set.repository.split("/")
    for place in (data / f"{owner}+{name}", data / owner / name, data / name):
        if place.is_dir():
            return place
    new = data / f"{owner}+{name}"
    address = f"https://github.com/{field_set.repository}"
    subprocess.run(["git", "clone", "--bare", "--filter=blob:none", address, str(new)], check=True)
    return new

"""The file formats that poses are read from and written to, as each format's own module declares them.

Options, the client and the web process need a format's name and properties, but must not load its reader, which needs
NumPy. A declaration therefore has literal values only, and is read from the module's source without importing it.
Other packages add formats by an entry point of the group `GROUP`, which names a module.
`biresnerf.data.formats.registry` adds the functions that read and write.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

Need = Literal["photos", "images folder", "lens file", "bounds", "input"]
Loss = Literal[
    "poses", "names", "lenses", "some lenses", "distortion", "rigs", "points", "mask paths", "masks"
]

GROUP = "biresnerf.formats"
_PACKAGE = Path(__file__).resolve().parents[2]
_FOLDER = _PACKAGE / "biresnerf" / "data" / "formats"
_DECLARATION = re.compile(r"^\w+ = Format\(\n.*?^\)$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Format:
    """One format.

    Attributes:
        name: what options, commands and the API call it.
        title: what people call it.
        rank: its place in lists, and in the order in which a folder is searched for poses; unique.
        found_as: names (or a pattern with ``*``) under which a folder holds it, the preferred one first; empty for
            formats that are not read.
        suffixes: of files that are read as this format when given as the input.
        gives: what reading it gives, for the docs.
        checked_against: what its reader was tested with, for the docs.
        in_set: where `convert` writes it in its folder; empty for formats that it does not write.
        in_result: where it lies in the folder of a result; default: `in_set`.
        always: every result has it.
        axes, cam_from_world, quaternion: how it writes poses, to check whether a file means what the format says: the
            camera's axes, whether world to camera, and the order of its quaternions.
        needs: ``photos``: the input's photos; ``images folder``: all of them directly in images/; ``lens file``: a
            camera.json beside it, as it has no lenses; ``bounds``: depths of the nearest and farthest point; ``input``:
            the input's own file.
        loses: what of a set it cannot hold.
        panoramas: it holds lenses of panoramas.
        splats: programs that train splats start from its points.
        instead: the format that is written in its place where it cannot hold the set's lenses.
        lacks: more that it cannot hold, in words, for the docs.
        heading, hint: whom its download is for, and how it is used.
        downloads: the files that belong to it in a result: one file, or a folder with a slash at its end; `in_result`
            where left out.
        module: where it is declared.
    """

    name: str
    title: str
    rank: int
    found_as: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()
    gives: str = ""
    checked_against: str = ""
    axes: Literal["opencv", "opengl"] = "opencv"
    cam_from_world: bool = False
    quaternion: Literal["", "wxyz", "xyzw"] = ""
    in_set: str = ""
    in_result: str = ""
    always: bool = False
    needs: tuple[Need, ...] = ()
    loses: tuple[Loss, ...] = ()
    panoramas: bool = False
    splats: bool = False
    instead: str = ""
    lacks: str = ""
    heading: str = ""
    hint: str = ""
    downloads: str = ""
    module: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "in_result", self.in_result or self.in_set)

    @property
    def of_result(self) -> bool:
        """Whether a finished result can be written in it: it needs nothing else but photos."""
        return bool(self.in_result) and not {"input", "bounds"} & set(self.needs)

    @property
    def holds_bodies(self) -> bool:
        """Whether it holds poses without points or photos, so that it can hold those of a robot's flange."""
        return "points" in self.loses and "poses" not in self.loses and "photos" not in self.needs

    @property
    def on_request(self) -> bool:
        """Whether a result is written in it on request only."""
        return self.of_result and not self.always


@cache
def formats() -> dict[str, Format]:
    """All formats by name, in the order of their ranks."""
    places = {point.module: _source_of(point.module) for point in entry_points(group=GROUP)}
    for path in sorted(_FOLDER.rglob("*.py")):
        places[".".join(path.relative_to(_PACKAGE).with_suffix("").parts).removesuffix(".__init__")] = path
    found = [declared for module, path in places.items() for declared in _declared_in(path, module)]
    return {declared.name: declared for declared in sorted(found, key=lambda declared: declared.rank)}


def _source_of(module: str) -> Path:
    """The file of a module, without importing it; its parent packages are imported."""
    found = find_spec(module)
    if found is None or found.origin is None:
        raise ModuleNotFoundError(
            f"An entry point of {GROUP} names {module}, which is not there.", name=module
        )
    return Path(found.origin)


def _declared_in(path: Path, module: str) -> Iterator[Format]:
    """The declarations ``NAME = Format(...)`` of a module, the closing bracket on a line of its own."""
    for match in _DECLARATION.finditer(path.read_text("utf-8")):
        call = ast.parse(match[0].split(" = ", 1)[1], mode="eval").body
        assert isinstance(call, ast.Call)
        values = {str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords}
        yield Format(**values, module=module)


PosesOf = Literal["camera", "body"]  # whose poses: the camera's, or those of what carries it

# The formats that a result is written in on request, as a type that options and the API's schema list.
if TYPE_CHECKING:
    ExportName: TypeAlias = str
else:
    ExportName = Literal[tuple(name for name, one in formats().items() if one.on_request)]

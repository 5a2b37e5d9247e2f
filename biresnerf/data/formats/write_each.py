"""Write several formats of one set separately; a format that cannot hold the set's lenses is replaced by another."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError
from biresnerf.options.formats import formats


@dataclass
class Writing:
    """The outcome for the formats.

    Attributes:
        written: their names.
        notes: a sentence for each that was replaced by another, and for what programs will miss.
        refused: why the others were not written.
    """

    written: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    refused: dict[str, InputError] = field(default_factory=dict)

    def raise_first(self) -> None:
        """Raises InputError where a format was refused."""
        for error in self.refused.values():
            raise error


def write_each(refined: RefinedSet, names: Iterable[str], write: Callable[[str], None]) -> Writing:
    """Calls ``write`` for each name, and where that format cannot hold the set, for what it declares as ``instead``.

    Without the photos of ``refined`` no format is replaced.
    """
    result, waiting = Writing(), list(dict.fromkeys(names))
    with_photos = all(image.path is not None for image in refined.images)
    for name in waiting:  # grows on the way
        other = formats()[name].instead if with_photos else ""
        try:
            write(name)
        except InputError as error:
            if error.code != "export_not_possible" or not other:
                result.refused[name] = error
                continue
            result.notes.append(f"{other} was written instead of {name}: {error.where}: {error.detail}")
            waiting += [other] if other not in waiting else []
        else:
            result.written.append(name)
    bare = [name for name in result.written if formats()[name].splats]
    if bare and not len(refined.model.points):
        result.notes.append(
            f"{', '.join(bare)}: there are no points, which 3DGS, gsplat and splatfacto start from."
        )
    return result

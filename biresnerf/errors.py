"""The errors the library raises on purpose. Everything else is a bug."""

from __future__ import annotations


class BiresnerfError(Exception):
    """Base of all errors raised on purpose."""


class InputError(BiresnerfError):
    """Something the user can fix.

    Args:
        code: stable machine-readable name, snake_case (for example ``pose_file_invalid``).
        what: what is wrong, in one sentence.
        where: the file, and the field inside it where there is one.
        hint: what to do about it.
    """

    def __init__(self, code: str, what: str, *, where: str = "", hint: str = "") -> None:
        self.code, self.what, self.where, self.hint = code, what, where, hint
        super().__init__(" ".join(part for part in (f"{where}:" if where else "", what, hint) if part))


class RefinementError(BiresnerfError):
    """The optimisation could not go on (diverged, nothing to render). Carries a stable ``code``."""

    def __init__(self, code: str, what: str) -> None:
        self.code, self.what = code, what
        super().__init__(what)


class Interrupted(BiresnerfError):
    """Stopped on request; a checkpoint and a usable partial result are in the output folder."""

"""The errors raised on purpose, and the fault they carry. Everything else is a bug."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

from pydantic import Field

from biresnerf.frozen_model import FrozenModel

# This variable is set where a fault of ours must end the run, and not leave it with less evidence: in tests.
FAULTS_RAISE = "BIRESNERF_FAULTS_RAISE"


class Fault(FrozenModel):
    """What is wrong and how to fix it, the same in an exception, in a job's error and in an HTTP answer."""

    code: str = Field(description="Stable machine-readable name in snake_case.", examples=["unsafe_path"])
    detail: str = Field(description="What is wrong, in one sentence.", examples=["The name has a part `..`."])
    where: str = Field(
        "",
        description="The file or entry at fault, and the field in it where there is one.",
        examples=["../evil.png"],
    )
    hint: str = Field(
        "",
        description="What to do about it.",
        examples=["Pack the archive with relative names inside one folder."],
    )

    def __str__(self) -> str:
        return " ".join(part for part in (self.where and f"{self.where}:", self.detail, self.hint) if part)


class BiresnerfError(Exception):
    """Base of all errors raised on purpose."""


class FaultError(BiresnerfError):
    """Base of the errors that carry a `Fault`; its fields can be read from the error, too."""

    def __init__(self, code: str, detail: str, *, where: str = "", hint: str = "") -> None:
        self.fault = Fault(code=code, detail=detail, where=where, hint=hint)
        self.code, self.detail, self.where, self.hint = code, detail, where, hint
        super().__init__(str(self.fault))

    @classmethod
    def of(cls, fault: Fault, **others: Any) -> Self:
        """An error of this class that carries ``fault``; ``others`` are the class's further arguments."""
        return cls(fault.code, fault.detail, **{"where": fault.where, "hint": fault.hint} | others)


class InputError(FaultError):
    """Something that the user can fix."""


class RefinementError(FaultError):
    """The optimisation could not go on: it diverged, or there is nothing to render."""


class Interrupted(BiresnerfError):
    """Stopped on request; a checkpoint and a usable partial result are in the output folder."""


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Context for imports of what an extra of this package installs; raises `InputError` (``extra_missing``)."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(
            "extra_missing",
            f"The package {error.name} is not installed.",
            hint=f"Install it with: pip install 'biresnerf[{extra}]'",
        ) from None

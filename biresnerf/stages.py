"""The stages of a run, in their order."""

from __future__ import annotations

from typing import Literal

Stage = Literal["preparing", "seeding", "coarse", "fine", "evaluating", "exporting"]
STAGES: tuple[Stage, ...] = ("preparing", "seeding", "coarse", "fine", "evaluating", "exporting")
# Stages whose work another run of the same set can take over.
ReusableStage = Literal["seeding", "coarse"]
REUSABLE_STAGES: tuple[ReusableStage, ...] = ("seeding", "coarse")

"""The stages of a run, in their order, and the file that says how far it is."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

Stage = Literal["preparing", "seeding", "coarse", "fine", "evaluating", "exporting"]
STAGES: tuple[Stage, ...] = ("preparing", "seeding", "coarse", "fine", "evaluating", "exporting")
# Stages whose work another run of the same set can take over.
ReusableStage = Literal["seeding", "coarse"]
REUSABLE_STAGES: tuple[ReusableStage, ...] = ("seeding", "coarse")
CHECKPOINT = Path("checkpoint") / "latest.safetensors"  # in the folder of a run
OTHER_FOLDER = "Choose another output folder, or remove this one."  # where a run cannot go on

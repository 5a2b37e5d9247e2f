"""The curve of a run, one line at each check of the detector: ``history.jsonl``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict, Field

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.frozen_model import FrozenModel

HISTORY = "history.jsonl"


class HistoryLine(FrozenModel):
    """One check of the detector. Studies add figures of their own."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    step: int
    stage: Literal["coarse", "fine"]
    psnr: float = Field(description="Of the mean error since the last check, dB.")
    loss: float = Field(description="Of the last step.")
    moved_deg: float = Field(
        description="90 % quantile of the cameras' rotation since the last check, degrees."
    )
    lost: int = Field(description="Cameras that do not agree with the field.")
    rays: int = Field(description="In the last step.")
    samples: int = Field(description="In the last step.")
    pose_rate: float = Field(description="Learning rate of the poses from here on.")
    field_rate: float
    reconstruction_rate: float
    seconds: float
    trend_db: float | None = Field(
        None, description="Stage 1: what the later half of its checks gained; from the sixth check on."
    )
    level_db: float | None = Field(
        None, description="How large a trend still counts as level: 15 % of all that was gained."
    )
    confirmed: int | None = Field(None, description="Checks in a row that found the error stable.")


class History:
    """Appends lines to ``folder``/history.jsonl; a continued run drops those after its checkpoint first."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / HISTORY

    def cut(self, step: int) -> None:
        """Keep only the lines up to `step`: a continued run writes the later ones again."""
        if not self.path.is_file():
            return
        kept = [line for line in read_history(self.path) if float(line["step"]) <= step]
        with whole_file(self.path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept), "utf-8")

    def append(self, line: Mapping[str, object]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")


def read_history(path: Path) -> list[dict[str, float | str]]:
    """The lines of a history, without one that a kill cut off."""
    lines = []
    for text in path.read_text("utf-8").splitlines():
        try:
            lines.append(json.loads(text))
        except ValueError:
            continue
    return lines

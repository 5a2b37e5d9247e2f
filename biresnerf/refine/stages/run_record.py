"""What has happened in a run so far, as kept in checkpoints."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from biresnerf.report import SwitchReason


@dataclass
class RunRecord:
    """What has happened so far.

    Attributes:
        fingerprint: of input and options.
        stage_1_fingerprint: the same without the options that have no say in stage 1.
        seeding: COLMAP's answer where poses come from it: another run would find others.
        start: the poses started from, as `Start.as_json`.
    """

    fingerprint: str
    stage_1_fingerprint: str = ""
    resumed: int = 0
    rollbacks: int = 0
    switch_reason: SwitchReason | None = None
    seeding: str | None = None
    start: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: {"coarse": 0.0, "fine": 0.0})

    def notes(self) -> dict[str, Any]:
        """For a checkpoint."""
        return dict(vars(self))

    def take(self, notes: dict[str, Any]) -> None:
        """What `notes` gave; the fingerprints stay, as options that do not matter to either may differ."""
        for name in ("resumed", "rollbacks", "switch_reason", "seeding", "start", "seconds"):
            setattr(self, name, notes[name])

"""Where the optimisation starts: at the given poses, or at those feature matches support, whichever the photos prefer.

The trial is short and cannot favour one side: see `biresnerf.refine.start.frozen_trials`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from biresnerf.data.model.dataset import GUESSES
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.seeding.seed_poses import PoseCandidate
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from biresnerf.refine.optimise.methods import METHODS
from biresnerf.refine.start.frozen_trials import FrozenTrials, trial_views
from biresnerf.report import PoseSource, TrialReport

logger = logging.getLogger(__name__)

MATCHED_SOURCES: frozenset[PoseSource] = frozenset({"colmap", "matches-incremental", "matches-global"})

TRIAL_STEPS = 200
# Of the pose rate, in stage 1 and 2: what cameras placed by matches may move by. They are off by tenths of a degree,
# and at the full rate the steps alone carry them further before the field can tell: fox, from 0.29 deg, ended 1,500
# steps later at 1.03 with the full rate, 0.64 with a fifth of it, 0.28 with these.
MATCHED_MOBILITY = (0.0, 0.3)
# Where most cameras are placed, stage 1 has only to form the field: its lengths shrink to this share.
MOSTLY_PLACED, MATCHED_COARSE_SHARE = 0.8, 2 / 3
DOUBTED_MOST = 0.5  # of the cameras: with more guesses there is no field of others to agree with
MARGIN_DB = 0.3  # less is a tie
# On a tie, matches are believed if the given poses differ from them by more than this (median).
DISAGREE_DEG = 2.0


@dataclass(frozen=True, eq=False)
class Start:
    """Poses to start from.

    Attributes:
        world_from_cam: float64 [n, 4, 4], in the frame of the given poses.
        source: whose they are, as a whole.
        sources: who found each of them.
        trials: how every candidate did; empty if there was nothing to choose between.
    """

    world_from_cam: np.ndarray
    source: PoseSource
    sources: tuple[PoseSource, ...]
    trials: tuple[TrialReport, ...] = ()

    @classmethod
    def of(cls, candidate: PoseCandidate) -> Start:
        return cls(candidate.world_from_cam, candidate.name, candidate.sources)

    @property
    def placed(self) -> np.ndarray:
        """Bool [n], whether feature matches gave the pose."""
        return np.array([source in MATCHED_SOURCES for source in self.sources])

    @property
    def doubted(self) -> np.ndarray:
        """Bool [n], whose pose is a guess from other images; nobody where most are, as all are alike then."""
        guessed = np.array([source in GUESSES for source in self.sources])
        return guessed if guessed.mean() <= DOUBTED_MOST else np.zeros_like(guessed)

    @property
    def sound(self) -> np.ndarray:
        """Bool [n], whose pose is as good as any of the set's."""
        return ~(self.doubted | self.stray)

    @property
    def stray(self) -> np.ndarray:
        """Bool [n], whom matches left out where they placed most.

        Such a camera must not teach the field: one of few photos finds room for itself from any pose, however little
        it weighs (fountain-P11's sixth, 20 degrees off, was taken in unnoticed).
        """
        placed = self.placed
        return ~placed if placed.mean() >= MOSTLY_PLACED else np.zeros_like(placed)

    @property
    def mobility(self) -> np.ndarray:
        """Each camera's factor of the pose rate [2, n] in stage 1 and stage 2."""
        return np.where(self.placed[None], np.array(MATCHED_MOBILITY)[:, None], 1.0)

    def stage_lengths(self, asked: RefineOptions, resolved: ResolvedOptions) -> ResolvedOptions:
        """`resolved` with a shorter stage 1 where matches have placed most cameras, unless one was `asked` for."""
        if self.placed.mean() < MOSTLY_PLACED or not METHODS[resolved.method].additions:
            return resolved
        names = [n for n in ("coarse_steps_min", "coarse_steps_max") if getattr(asked, n) is None]
        shorter = {name: round(MATCHED_COARSE_SHARE * int(getattr(resolved, name))) for name in names}
        return resolved.model_copy(update=shorter)

    def as_json(self) -> dict[str, Any]:
        """For a checkpoint: a continued run starts from the same poses without another trial."""
        return {
            "world_from_cam": self.world_from_cam.tolist(),
            "source": self.source,
            "sources": list(self.sources),
            "trials": [trial.model_dump() for trial in self.trials],
        }

    @classmethod
    def from_json(cls, kept: dict[str, Any]) -> Start:
        trials = tuple(TrialReport.model_validate(trial) for trial in kept["trials"])
        return cls(np.array(kept["world_from_cam"]), kept["source"], tuple(kept["sources"]), trials)


def choose_start(
    candidates: list[Start],
    images: ImageSet,
    options: ResolvedOptions,
    device: torch.device,
    threads: int,
    should_stop: Callable[[], bool],
) -> Start:
    """The candidate whose poses let a field predict unseen views best.

    On a tie the first one is kept, unless it is the given poses and the matches do not agree with them.

    Raises:
        Interrupted: ``should_stop`` said so.
    """
    rigs = [candidate.world_from_cam for candidate in candidates]
    trials_of = FrozenTrials(
        images, trial_views(len(images)), rigs, options, TRIAL_STEPS, device, threads, should_stop
    )
    scores = [float(trials_of.score(rig).psnr.mean()) for rig in rigs]
    best = int(np.argmax(scores))
    if scores[best] < scores[0] + MARGIN_DB:
        matched = int(np.argmax(scores[1:])) + 1
        disagree = float(
            np.median(rotation_between_deg(candidates[0].world_from_cam, candidates[matched].world_from_cam))
        )
        believed = candidates[0].source == "given" and disagree > DISAGREE_DEG
        best = matched if believed and scores[matched] > scores[0] - MARGIN_DB else 0
    trials = tuple(
        TrialReport(source=c.source, placed=int(c.placed.sum()), psnr=s)
        for c, s in zip(candidates, scores, strict=True)
    )
    chosen = candidates[best]
    logger.info("start: %s of %s", chosen.source, ", ".join(f"{t.source} {t.psnr:.2f} dB" for t in trials))
    return replace(chosen, trials=trials)

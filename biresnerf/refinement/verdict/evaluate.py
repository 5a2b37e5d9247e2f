"""After the last step: held-out views are scored, views rendered to be looked at, and the orbit filmed."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.show.view_file import ShownView
from biresnerf.geometry.similarity import Similarity
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.views.evaluation import ViewScore, render_orbit, score_views
from biresnerf.refinement.views.shown_views import Points, spread_views, surface_of

logger = logging.getLogger(__name__)

SHOWN_WITHOUT_HELD_OUT = 2  # training views rendered when none is held out
SHOWN_SHARE = 0.05  # of the run's time, at most, for further views


class Pictures(Protocol):
    """Keeps what is rendered."""

    def write_view(self, score: ViewScore) -> ShownView: ...
    def write_orbit(self, frames: Iterator[NDArray[np.generic]]) -> None: ...


@dataclass
class Evaluation:
    """What was measured and rendered.

    Attributes:
        scores: of the held-out views.
        views: all that were rendered.
        surfaces: for each of them the points that it sees, in the unit frame.
    """

    scores: list[ViewScore] = field(default_factory=list)
    views: list[ShownView] = field(default_factory=list)
    surfaces: list[Points] = field(default_factory=list)

    def surface(self, unit_from_world: Similarity, input_from_optimised: Similarity) -> Points:
        """All points in the input's frame."""
        if not self.surfaces:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8)
        positions, colours = (np.concatenate(parts) for parts in zip(*self.surfaces, strict=True))
        return input_from_optimised.apply(unit_from_world.inverse().apply(positions)), colours


def evaluate(
    scene: Scene, renderer: Renderer, options: ResolvedOptions, run: RunState, pictures: Pictures
) -> Evaluation:
    """Score and render views, film the orbit.

    Raises:
        Interrupted: stopped; a continued run evaluates again.
    """
    first = scene.held_out or list(range(min(SHOWN_WITHOUT_HELD_OUT, len(scene.dataset))))
    frames, more = options.orbit_frames, options.shown_views
    further = spread_views(scene.dataset.world_from_cam, first, more)
    work = len(first) + len(further) + frames

    def report(done: int) -> None:
        run.monitor.raise_if_stopped("stopped while the result was measured; run again to go on")
        run.report_evaluation(done / max(1, work), done, work)

    report(0)
    evaluation = Evaluation()
    shown = chain(first, _while_cheap(further, sum(run.record.seconds.values())))
    for score in score_views(renderer, scene.images, shown):
        evaluation.views.append(pictures.write_view(score))
        evaluation.surfaces.append(surface_of(renderer, score))
        if score.image in scene.held_out:
            evaluation.scores.append(score)
        report(len(evaluation.views))
    if frames:
        views = len(first) + len(further)
        pictures.write_orbit(render_orbit(renderer, frames, lambda i: report(views + i + 1)))
    return evaluation


def _while_cheap(views: list[int], spent_before_s: float) -> Iterator[int]:
    """The views one by one, until showing another would take more than its share of the run."""
    started = time.monotonic()
    for done, view in enumerate(views):
        spent = time.monotonic() - started
        if done and spent * (done + 1) / done > SHOWN_SHARE * spent_before_s:
            logger.info("%d of %d further views rendered: more would take too long", done, len(views))
            return
        yield view

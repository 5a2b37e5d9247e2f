"""Numbers of lost cameras: which poses are tried for them, when, and what those may cost."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LostNumbers:
    """How lost cameras are repaired. When a repair is due within stage 1 depends on the scene: `SceneKind.repairs`."""

    score_side: int = 20  # a pose is scored on 20 x 20 pixels spread over the photo
    references: int = 16  # cameras that stand for all others in the acceptance
    # Poses kept, rays a step of each, steps.
    rounds: tuple[tuple[int, int, int], ...] = ((6, 48, 40), (2, 128, 50))
    rates: tuple[float, float] = (1e-2, 1e-3)  # pose learning rate of the first and the last step
    distinct_deg: float = 8.0  # poses nearer than this to a better one are not tried beside it
    least_interval: float = 1.2e-2  # unit lengths: scoring needs no finer samples
    near_median: float = 1.5  # times the others' median error, below which a camera is one of them
    alone_most: float = 0.2  # of all cameras: where more share too little, the photos were taken so
    last_share: float = 0.6  # of all steps: the repair within stage 2
    settled_share: float = 1 / 3  # of stage 2, at the least before that
    run_share: float = 0.1  # of the run's samples: what all repairs may cost
    event_share: float = 0.04  # of the run's samples: what those of one time may cost
    guessed_times: int = 2  # that much where poses are guesses: more cameras need it
    forward_cost: float = 0.4  # of a sample without its backward pass
    # Poses that are tried.
    neighbours: int = 8  # cameras whose correction is tried, and cameras whose place is tried
    orbits_deg: tuple[float, ...] = (10, 20, 30, 45, 60)  # about the scene
    rolls_deg: tuple[float, ...] = (-20, 20, -90, 90, 180)  # also photos stored on their side or upside down
    # Errors of an image's own matches beyond so many times the median image's contradict its pose. The largest of any
    # camera of fountain-P11, lego at 200 px, temple, fox and the dome scene, at true poses and at noise of 0.005 and
    # 0.15: 3.6.
    times_usual: float = 8.0
    # Times the median image's error: how near to its feature a point must appear to agree with a pose.
    agree: float = 4.0
    least_parallax_deg: float = 1.0  # of points that a camera is placed by

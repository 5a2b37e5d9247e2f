"""Numbers of what chooses between sets of poses: at the start, by unseen views, and in the verdict."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StartNumbers:
    """How initial poses are chosen, or found without features."""

    # Right poses explain so many of the matches that no mapping was shown, wrong ones fewer: 0.95 to 0.98 on five sets,
    # and 0.56 to 0.59 for coffee's wrong models (docs/input.md).
    explains: float = 0.9
    # Of trainings in which the candidates' poses move, where those at rest do not decide.
    moving_steps: int = 400
    facing_first_steps: int = 800  # of cameras that begin at one place
    facing_second_steps: int = 800  # of what these find and of its mirror image
    facing_samples: int = 1 << 14  # of a step of either
    elevations_deg: tuple[float, ...] = (-30.0, 0.0, 30.0, 60.0)  # of the rings that are tried first
    near_deg: float = 8.0  # from the elevation found among those, up and down
    ring_steps: int = 150  # of each try
    ring_samples: int = 1 << 12  # of a step
    ring_unseen_rays: int = 1 << 13  # pixels of all unseen photos that are rendered after each try


@dataclass(frozen=True)
class ViewNumbers:
    """Which views are left out of a training, and how it and they are measured."""

    one_in: int = 5  # unseen views of a trial: one in so many
    views_most: int = 16  # but no more than that
    trial_samples: int = 1 << 14  # of a step
    # Times the fine interval that a short training's field is rendered at, for 0.4 to 0.8 of the time: unseen views
    # keep their PSNR to 0.06 dB (fox, lego, fountain-P11). Trained at it, too, fountain-P11 loses 0.7 dB.
    coarser: float = 2.0
    # Pixels of all unseen views that are rendered at the end, for each step of the training.
    rays_per_step: int = 100
    hold_out_one_in: int = 10  # views of a run, to be scored
    hold_out_most: int = 10  # of them
    hold_out_from: int = 6  # photos; none of fewer
    least_views: int = 5  # unseen by the verdict's trainings, where the set is large enough to spare them
    spared_of: int = 3  # and one in so many at most
    # Fewer unseen views leave too wide an interval: trainings are repeated with others left out.
    enough_views: int = 8
    rounds_most: int = 3  # of trainings
    most_unseen: int = 16  # of a round
    fit_steps: int = 100  # BARF's test-time pose refinement
    fit_rate: float = 1e-3  # of the poses in it, at its first step
    fit_rays: int = 1024  # of a step of it
    fit_exposure_rate: float = 1e-2  # of the exposures in it, at its first step


@dataclass(frozen=True)
class VerdictNumbers:
    """What unseen views, matches and motion must show for a verdict, and which photos are flagged."""

    # Poses that photos miss by less than half of a motion are nearer to the truth than those before it: the triangle's
    # inequality. Short trainings blur, and so miss by up to so much at true poses (px at working size,
    # docs/verdict.md).
    nearer: float = 0.5
    blur_px: float = 2.0  # see above
    # A gain of views that are missed by more than half of the motion must stand in trainings so many times as long.
    longer: int = 4
    # Before the end of a training chance is larger, as its rates have not fallen yet: 0.3 dB.
    early: float = 2  # times what matters
    measurable_px: float = 0.1  # at working size: less motion cannot be seen in photos of that size
    # Matches support poses only if their error drops by so large a share of the motion, apart from one px of it:
    # poses that fitted well need not move far to fit a little better (docs/verdict.md).
    explained: float = 0.1
    unexplained_px: float = 1.0  # see above
    mostly: float = 0.5  # share of cameras; if more fail a check, the whole set fails it
    far_deg: float = 60.0  # median residual; beyond, the result is only roughly in the input's frame
    far_share: float = 0.5  # the same of the centres, of their spread
    least_matched: int = 4  # images with matches; fewer say nothing
    one_place: float = 0.9  # of the matches that rotations alone explain: the report warns
    blurred_below: float = 0.3  # of the neighbours' sharpness: a blur of about one px of the working size
    exposure_off: float = 0.2  # log of the gain against the median photo's: a fifth, or a quarter of a stop
    exposure_deviations: float = 5.0  # robust standard deviations that it must stand out by as well
    # A pose moved far by more than so many medians, and at least so many degrees or so much of the cameras' distance.
    moved_times: float = 4.0
    moved_deg: float = 1.0  # see above
    moved_share: float = 0.02  # see above

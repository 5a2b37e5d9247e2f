"""Numbers of the steps: the schedule, cameras that stand out, and the switch to stage 2."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScheduleNumbers:
    """How learning rates, sampling and smoothing change over the steps; `SceneKind` has what open scenes change."""

    fine_interval: float = 3.3e-3  # unit lengths; BAA-NGP's 5e-3 in a box of side 3
    # Shares of the cameras' distance, at the start and from the switch on: nothing nearer is sampled. A field that may
    # put colour right in front of each camera explains any photo from any pose.
    near_shares: tuple[float, float] = (0.4, 0.1)
    unpruned_share: float = 0.1  # of the least length of stage 1: until then every cell counts as occupied
    ramp_share: float = 0.75  # of the greatest length of stage 1: the interval has reached its fine value
    blur_end_share: float = 0.6  # of the greatest length of stage 1: photos are sharp from then on
    blur_pixels: float = 0.03  # blur at the start, as a share of the long side (6 px of 200)
    field_start: int = 200  # steps of the paper's 40 000 over which the field's rate rises from zero
    pose_start: int = 500  # the same of the poses' rate
    pose_dip: float = 0.05  # pose rate right after the switch, as a share
    pose_stage2_cap: float = 1e-3  # most pose rate in stage 2
    # Intrinsics begin to move at this share of the least length of stage 1, and rise over as many steps again. Before
    # it, focal lengths answer to poses that are still off (lego at noise 0.05: from 5 to 6.6 % too long).
    lens_start: float = 0.5
    lens_share: float = 1.0  # of the poses' rate
    field_dip: float = 0.3  # field rate right after the switch, as a share
    freeze_share: float = 0.95  # of all steps: poses stand still from then on
    # As NerfAcc: from the start, steps that look at all cells of the occupancy grid; then the share of the empty ones.
    fresh_steps: int = 256
    empty_looked_at: float = 0.25  # see above
    occupancy_period: int = 16  # steps from one update of the occupancy grid to the next


@dataclass(frozen=True)
class ErrorNumbers:
    """Which cameras stand out by the error of their photos."""

    stands_out: float = 2.0  # times the median error
    stands_out_untrained: float = 4.0  # for held-out views too few to be compared with each other
    # And this many standard deviations, estimated as 1.4826 x the median absolute deviation.
    deviations: float = 4.0
    suspect_deviations: float = 2.0  # enough to try other poses, which are judged on their own
    # A photo that is hard to render stands out late in a run, when others are nearly exact (0.03 at most on lego and
    # temple); a camera in a wrong place leaves this share of its photo's variance unexplained (0.12 and more there).
    unexplained: float = 0.08
    # Few photos predict an unseen one badly from good poses, too: ten of fountain-P11 leave 0.28 of the eleventh.
    unexplained_untrained: float = 0.7
    own_yardstick_from: int = 4  # held-out views
    in_a_row: int = 2  # blocks
    # Of the photo's foreground share: a camera that renders less no longer sees the scene.
    coverage: float = 0.1
    doubted_weight: float = 0.1  # of a camera with a guessed pose, until it agrees with the field
    smoothing: float = 0.5  # share of the newest block in the moving average


@dataclass(frozen=True)
class SwitchNumbers:
    """When the error is level: stage 2 begins."""

    least_checks: int = 6  # before anything is said: three in the later half make a line with a deviation
    level_share: float = 0.15  # of all that was gained: what the later half may bring, or scatter by
    confirmations: int = 2  # checks in a row

"""What a run does differently in open scenes, whose photos show surroundings instead of a background."""

from __future__ import annotations

from dataclasses import dataclass

from biresnerf.judging.compare import FACING_FORWARD, FACING_FORWARD_BOUNDED, Rule


@dataclass(frozen=True)
class SceneKind:
    """The numbers of a scene with a background; `OPEN` has those of an open one."""

    # Ray marching interval at the start, unit lengths: half a cell of the pose module.
    coarse_interval: float = 2.5e-2
    interval_pixels: float = 0.4  # of a pixel: the interval is no finer
    samples: int = 1  # times the samples of a step that the options request
    pose_start: float = 0.0  # of the least length of stage 1, over which the poses' rate rises at the least
    # Of the least length of stage 1: when lost cameras are looked for. The field has formed by half of it.
    repairs: tuple[float, ...] = (0.5, 1.0)
    # Share of its view: a camera that others share less with must go elsewhere, however small its error. None where the
    # scene ends at its box, and a camera that looks elsewhere sees nothing.
    alone: float = 0.0
    facing_forward: Rule = FACING_FORWARD_BOUNDED  # by which cameras that began at one place are believed
    trial_steps: int = 1  # times the steps of a training that compares poses
    step_work: float = 1.0  # times the work of a step in a scene with a background
    evaluation_work: float = 1.0  # times that of the evaluation


OPEN = SceneKind(
    # Samples fill the whole ray: coarser intervals and twice the budget keep enough rays.
    coarse_interval=3e-2,
    interval_pixels=1.0,
    samples=2,
    # Without a background to stand out from, gradients mean nothing until the field has formed: poses that move from
    # the first step drift away (fox at noise 0.05: 3.9 deg became 5.1; with this wait, 1.6).
    pose_start=0.5,
    repairs=(1.0,),
    alone=0.2,
    facing_forward=FACING_FORWARD,
    # Until a field of an open scene has formed, good poses predict unseen views no better than bad ones (fountain-P11:
    # no difference after 200 steps, 4 dB after 400).
    trial_steps=2,
    step_work=1.6,  # as measured (docs/speed.md)
    evaluation_work=2.0,  # as measured (docs/speed.md), of entry-P10 and lund_door
)


@dataclass(frozen=True)
class SceneKinds:
    """Both kinds of scenes."""

    bounded: SceneKind = SceneKind()  # photos have a background
    open: SceneKind = OPEN  # they show surroundings

    def of(self, unbounded: bool) -> SceneKind:
        """The kind of a scene, by whether its photos show surroundings."""
        return self.open if unbounded else self.bounded

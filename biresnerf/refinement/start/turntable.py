"""A start from no poses at all, for photos of something that turns before the camera: rings of cameras, tried.

A ring has few unknowns: the way it turns, its elevation, where the axis stands in the photo. Scale and distance are
free. The order of the photos is found first (`ring_order`). Each try is a short training in which the cameras stay on
their ring, while its roll, pan and each azimuth move (`RingParameters`). The elevation is searched: a field that forms
with a wrong one fits itself to it, so its gradient says little, but a parabola through what three elevations leave
unexplained does.

Seen from far away, a ring that turns the other way at the opposite elevation about an object mirrored in depth gives
the same photos (the bas-relief ambiguity); perspective distinguishes them, so both ways are tried.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from biresnerf.data.photos.alike.turning_object import IN_THE_WAY, still_surroundings
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.errors import InputError
from biresnerf.geometry.level_ring import order_on_ring
from biresnerf.geometry.turntable import Ring
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.parameters.ring_parameters import RingParameters
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.start.ring_order import RingOrder, axis_in_photos, find_ring, thumbnails
from biresnerf.refinement.views.pose_trials import Trial, score_unseen, trial_views
from biresnerf.report import TrialReport

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Tried:
    """A ring after a short run.

    Attributes:
        psnr: mean over unseen photos, dB.
    """

    ring: Ring
    psnr: float


class RingTrials:
    """Short runs of rings of cameras about the same photos."""

    def __init__(
        self,
        images: ImageSet,
        order: RingOrder,
        recipe: Recipe,
        should_stop: Callable[[], bool],
    ) -> None:
        self._run = torch.from_numpy(order.run)
        self.images, self.unseen = images, trial_views(len(images), recipe.method.views)
        self._recipe, self._should_stop = recipe, should_stop
        self._sampler = PhotoSampler(images, self.unseen, recipe.device, recipe.method.by_detail)
        pixels = int(sum(images.widths[v] * images.heights[v] for v in self.unseen))
        self._stride = max(1, math.ceil(math.sqrt(pixels / recipe.method.start.ring_unseen_rays)))
        even = torch.arange(len(images)) * (2 * torch.pi / len(images))
        self.frame = scene_frame(Ring.level(even).matrices(), images, recipe.method.scene)

    def run(self, ring: Ring) -> Tried:
        """Optimise a ring and a field; unseen photos move the ring, but do not train the field.

        Raises:
            Interrupted: ``should_stop`` returned true.
        """
        numbers = self._recipe.method.start
        steps = numbers.ring_steps
        short = self._recipe.apart(steps, (steps // 4, 2 * steps), numbers.ring_samples)
        poses = self.frame.unit_from_world.apply_to_poses(ring.matrices())
        reach = self._recipe.method.parameters.ring_reach
        moving = RingParameters(ring, self.frame.distance, self._run, self._recipe.device, reach)
        optimiser = JointOptimiser(
            self.images, self.frame, poses, short, self.unseen, sampler=self._sampler, poses=moving
        )
        Trial(optimiser, self.images, self.unseen, steps, self._should_stop).train(1.0)
        unseen = score_unseen(optimiser.renderer, self.images, self.unseen, self._stride)
        return Tried(moving.now().detached(), float(unseen.psnr.mean()))


def start_on_turntable(
    even: InitialPoses,
    images: ImageSet,
    recipe: Recipe,
    should_stop: Callable[[], bool],
) -> InitialPoses:
    """The ring of cameras that predicts unseen photos best, in a frame of its own.

    Its trials are those of the two ways to turn, the better one first.

    Args:
        even: cameras on a ring in the order of the photos' names.

    Raises:
        InputError: ``insufficient_overlap``: the photos' background stands still.
        Interrupted: ``should_stop`` returned true.
    """
    refuse_still_background(images)
    order = find_ring(images, order_on_ring(even.world_from_cam))
    trials = RingTrials(images, order, recipe, should_stop)
    ways = []
    for rings in rings_to_try(images, order, recipe.method.start.elevations_deg):
        tried = [trials.run(ring) for ring in rings]
        best = max(tried, key=lambda one: one.psnr)
        ways.append(trials.run(at_elevation(best.ring, likeliest_elevation(tried))))
    ways.sort(key=lambda one: -one.psnr)
    for one in ways:
        elevation = math.degrees(float(one.ring.elevation))
        logger.info("turntable: %.2f dB at an elevation of %.1f degrees", one.psnr, elevation)
    ring, near = ways[0].ring, math.radians(recipe.method.start.near_deg)
    # The one between starts where the others do, with azimuths that have moved already.
    heights = [float(ring.elevation) + shift for shift in (-near, 0.0, near)]
    closer = [trials.run(at_elevation(ring, height)) for height in heights]
    best = max(closer, key=lambda one: one.psnr)
    found = at_elevation(best.ring, likeliest_elevation(closer))
    logger.info("turntable: at an elevation of %.1f degrees", math.degrees(float(found.elevation)))
    reports = tuple(TrialReport(source="turntable", placed=0, psnr=one.psnr) for one in ways)
    return replace(even, world_from_cam=found.matrices(), trials=reports)


def likeliest_elevation(tried: Sequence[Tried]) -> float:
    """Elevation (radians) where the parabola through the best of the tries and its neighbours is highest.

    That of the best itself where it has a neighbour on one side only.
    """
    tried = sorted(tried, key=lambda one: float(one.ring.elevation))
    best = max(range(len(tried)), key=lambda i: tried[i].psnr)
    if best in (0, len(tried) - 1):
        return float(tried[best].ring.elevation)
    low, middle, high = tried[best - 1 : best + 2]
    x = [float(one.ring.elevation) for one in (low, middle, high)]
    rise, fall = (middle.psnr - low.psnr) / (x[1] - x[0]), (middle.psnr - high.psnr) / (x[2] - x[1])
    # The slopes halfway to the neighbours are `rise` and `-fall`.
    share = rise / (rise + fall) if rise + fall > 0 else 0.5
    return (x[0] + x[1] + share * (x[2] - x[0])) / 2


def at_elevation(ring: Ring, elevation: float) -> Ring:
    """The ring at another elevation, radians."""
    return replace(ring, elevation=torch.tensor(elevation))


def rings_to_try(images: ImageSet, order: RingOrder, elevations_deg: Sequence[float]) -> list[list[Ring]]:
    """Rings at a few elevations, a row for each way that they turn."""
    quarter, place = axis_in_photos(images, order)
    camera = images.cameras[order.order[0]].full()
    width = max(images.widths[order.order[0]], images.heights[order.order[0]])
    pan = math.atan(place * width / camera.fx)
    turn = torch.empty(len(images))
    turn[torch.from_numpy(order.order)] = torch.arange(len(images)) * (2 * torch.pi / len(images))
    quarters = torch.from_numpy(order.quarters + quarter)
    return [
        [
            Ring(way * turn, torch.tensor(math.radians(e)), torch.tensor(pan), torch.tensor(0.0), quarters)
            for e in elevations_deg
        ]
        for way in (1, -1)
    ]


def refuse_still_background(images: ImageSet) -> None:
    """Refuse photos whose background stands still: it would be taken for a part of what turns.

    Raises:
        InputError: ``insufficient_overlap``.
    """
    if images.background is None and images.counts is None and still_surroundings(thumbnails(images).mean(3)):
        raise InputError(
            "insufficient_overlap",
            "all photos show the same background, before which an object turns.",
            hint=IN_THE_WAY,
        )

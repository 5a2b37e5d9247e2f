"""Numbers of the unit frame, and of what moves beside poses."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FrameNumbers:
    """Where the scene is taken to lie, how large, and from where on it is sampled."""

    # Below this mean squared sine the axes are too parallel to say where they meet (a spread of about 6 degrees).
    converging: float = 0.01
    forward_facing_depth: float = 6.0  # in spreads of the camera centres, where nothing better is known
    content_margin: float = 1.15  # the box of what photos show is widened by this
    far_boxes: float = 60.0  # unbounded rays end this many inner boxes away (contracted to 1.98 of 2)
    # Sampling begins where this share of what cameras see is seen by witnesses that look less than a right angle
    # elsewhere: cameras across the scene do not help, as the scene lies between.
    witnessed: float = 0.8
    # Distances tried for that, as shares of the cameras' distance. Noisy poses share less: beyond 0.5 scenes may begin.
    nearest: float = 0.1
    farthest: float = 0.5  # see above
    # Pairs of matches that tell how far away the scene is. One whose epipolar error is larger is not used: either it or
    # the poses are wrong.
    agree_deg: float = 1.0
    pair_parallax_deg: float = 1.0  # between the rays of a pair; below, noise makes the depth
    pairs: int = 30  # at the least


@dataclass(frozen=True)
class ParameterNumbers:
    """What restrains exposures, lenses and rings."""

    # Standard deviation of the photos' logarithmic brightness from which on `auto` compensates: photos with equal
    # exposure stay below (0.02 to 0.03 in fern, horns, lund_door), with nothing to gain.
    exposure_from: float = 0.03
    exposure_rate: float = 1.0  # of the networks' learning rate
    # Weight of the squared logarithms: photos without evidence stay like the others.
    exposure_prior: float = 1e-4
    exposure_most: float = 3.0  # factor; a camera that does not see the scene would accept any
    saturated: float = 0.99  # a photo as bright as this may have been brighter
    # Expected standard deviations of the lenses' increments, and the weight of this prior in the loss: parameters
    # without evidence in the photos stay.
    lens_deviations: tuple[float, ...] = (0.2, 0.02, 0.05, 0.05, *(0.1,) * 11)
    lens_prior: float = 1e-6  # see above
    # Mean steps between photos on a ring: the reach, as a standard deviation, of what moves one azimuth.
    ring_reach: float = 3.0

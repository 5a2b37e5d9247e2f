"""Numbers of the adjustment of all cameras: how its evidence is weighted, and when photos and time decide."""

from __future__ import annotations

from dataclasses import dataclass

from biresnerf.data.model.dataset import IntrinsicsSource


@dataclass(frozen=True)
class EvidenceNumbers:
    """What evidence is taken, what is known before it, and when it is believed. `Evidence` carries them."""

    most_observations: int = 40_000  # of tracks, in candidates
    # The same in what is returned. On scarf 21,000 of 133,000 leave 0.090 deg, all of them 0.048.
    most_in_the_end: int = 400_000
    up_to_cameras: int = 500  # of these; more cameras get more of both, in proportion (`colmap_tracks`)
    lens_observations: int = 20_000  # that choose a lens's parameters; more add nothing
    left_out_one_in: int = 5  # patches
    most_patches: int = 3000  # in all
    patches_of_photo: tuple[int, int] = (20, 200)  # the least and the most of one photo
    opaque: float = 0.97  # opacity of surfaces that patches lie on, at the least
    flatness: float = 0.01  # largest deviation of a patch's surroundings from a plane, of the depth
    least_gradient: float = 0.01  # of the photo, 0 to 1 a pixel
    widest_deg: float = 40.0  # between the views of a patch that are compared
    agree: float = 0.03  # of the depth: the target sees the same place, not something before it
    # Expected of a pixel, 0 to 1: its own noise, and by how much of a pixel resampling and surface are off.
    pixel_noise: float = 0.01
    pixel_shift: float = 0.1  # see above
    scale_deviation: float = 0.03  # of a patch's depth, relative
    # From coarse to fine: blur of the photos (px), and the error at which a comparison has lost three quarters of its
    # weight. What decides is how soon that falls at the end: on the dome scene 3 left 0.20 degrees, 1.5 left 0.105 and
    # 0.7 left 0.065.
    patch_levels: tuple[tuple[float, float], ...] = ((1.0, 5.0), (0.5, 1.5), (0.5, 0.7))
    # Of halves of the patches. On the dome scene they end 0.07 degrees apart where they moved 0.3, and a third of the
    # comparisons fits; on lego at 100 px, where patches do harm, they end 0.34 apart of 0.5, and a fifteenth fits.
    most_apart: float = 0.3
    least_inliers: float = 0.2  # share of the comparisons; see above
    still_deg: float = 0.02  # halves this close agree, however little they moved
    # Standard deviations of the refined poses' errors, rad and distances of the cameras from the scene: far more than
    # they have, so that only what no evidence fixes is left to them.
    prior: float = 0.02
    # Standard deviation of a focal length, as a share of it, by who found it. Guesses: over 13 sets of photos of all
    # kinds, the logarithm of the focal length over the guess (1.2 of the long side) has 0.4. What COLMAP found is no
    # prior: it is of the same matches; what a network predicts counts as a guess, what a maker measured as
    # given. EXIF: whole millimetres of 35 mm film, and what stabilisation cuts off.
    focal_given: float = 0.02
    focal_exif: float = 0.05  # see above
    focal_guessed: float = 0.4  # see above
    radial_deviation: float = 0.1  # of distortion, as it moves the image's corner, as a share of its distance
    tangential_deviation: float = 0.01  # likewise
    # Of the principal point, as a share of the long side: six calibrated sets of photos have 0.3 to 3 %, in the root
    # mean square 1.1 % of either coordinate. Of the ratio of focal lengths: they have 0 to 0.4 %.
    centre_deviation: float = 0.01
    aspect_deviation: float = 0.005  # see above
    # A parameter is known from the evidence if its standard deviation there is less than this share of the one before:
    # the evidence then has eight ninths of the weight.
    observable: float = 1 / 3
    # A given focal length is contradicted if another one is preferred by more than so many standard deviations of what
    # is known before and of what the evidence says together.
    focal_contradicted: float = 2.0
    # Errors of lenses, of photos and of the field's surface are alike in many residuals and do not average out: by how
    # much they make errors of tracks larger than the noise does.
    track_model_error: float = 3.0
    patch_model_error: float = 1.25  # the same of patches
    # Root mean square errors (rad) beyond this are not known: the poses' errors are no longer linear in the residuals.
    most_rotation: float = 0.1
    # Of tracks, in px or in shares of the photos' size. Sets have 0.1 to 0.5 px.
    most_noise_px: float = 2.0
    most_noise: float = 0.002  # see above
    # Poses nearer than this to those that tracks prefer, in standard deviations of a camera's pose, may be the true
    # ones.
    told_apart: float = 2.0

    def focal_deviation(self, source: IntrinsicsSource) -> float:
        """The standard deviation of a focal length, by who found it."""
        known = {"given": self.focal_given, "maker": self.focal_given, "exif": self.focal_exif}
        return known.get(source, self.focal_guessed)


@dataclass(frozen=True)
class FinishNumbers:
    """When photos judge adjusted cameras, and how a run keeps to its time."""

    # In px at working size. Poses nearer to the truth than this predict unseen photos as well as it does
    # (docs/verdict.md).
    unseen_px: float = 0.5
    slack: float = 0.05  # of a run's time budget, that it may be over for a second adjustment
    least_steps: float = 0.1  # of the requested steps: with fewer, poses move but do not improve
    writing: float = 0.03  # of the budget, for the files of the result

"""Exposure compensation: three factors per photo, one per channel, optimised with poses and field.

Cameras choose exposure and white balance for each photo. A field with one colour per point would explain the
differences by haze in front of the cameras and by moving them. Three factors per photo cannot replace a pose: a factor
moves no edge. Photo colours are powers of the light, so a change of exposure is a factor on them, too.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.data.photos.images import ImageSet
from biresnerf.field.adam import Adam
from biresnerf.field.radiance_field import Rendering
from biresnerf.options.refine_options import ExposureChoice
from biresnerf.refinement.numbers.scene import ParameterNumbers


def brightness_spread(images: ImageSet) -> float:
    """Standard deviation over the photos of the logarithm of their mean colour, where pixels count."""
    means = []
    for i in range(len(images)):
        counts = images.counts_image(i)
        photo = images.image(i).reshape(-1, 3) if counts is None else images.image(i)[counts]
        means.append(np.log(max(float(photo.mean()), 1.0)))
    return float(np.std(means))


def compensates(images: ImageSet, choice: ExposureChoice, least_spread: float) -> bool:
    """Whether exposures are optimised: as requested; `auto` where opaque photos differ in brightness."""
    if choice == "auto":
        return images.alpha is None and brightness_spread(images) >= least_spread
    return choice == "on"


class Exposure:
    """The photos' factors and their optimiser. Over the training photos, the factors' mean logarithm is zero.

    Args:
        background: colour [3] behind the scene, which exposure does not change (it is not part of the photo's light, or
            saturated, or black); None where the scene has surroundings.

    Attributes:
        on: whether there is any compensation; otherwise all factors are and stay 1.
        log_gain: logarithm of the factors [n, 3].
    """

    def __init__(
        self,
        images: ImageSet,
        choice: ExposureChoice,
        held_out: list[int],
        background: Tensor | None,
        device: torch.device,
        numbers: ParameterNumbers = ParameterNumbers(),
    ) -> None:
        self._numbers = numbers
        self.on = compensates(images, choice, numbers.exposure_from)
        self.log_gain = torch.zeros(len(images), 3, device=device, requires_grad=self.on)
        self._background = background
        self._training = torch.ones(len(images), 1, device=device)
        self._training[held_out] = 0
        self.restart_adam()

    def restart_adam(self) -> None:
        """Forget the momentum of the steps so far."""
        self._adam = Adam([self.log_gain], betas=(0.9, 0.99), eps=1e-8)

    def shown(self, rendering: Rendering, image: Tensor) -> Tensor:
        """Rendered colours [rays, 3] as the photos `image` [rays] show them."""
        return self._lit(rendering, self.log_gain[image].exp()) if self.on else rendering.colour

    def refitted(self, rendering: Rendering, target: Tensor, weight: Tensor | None, groups: int) -> Tensor:
        """Colours [rays, 3] with factors for each of `groups` equal parts of the rays, fitted to `target` [rays, 3].

        For poses that are being tried: the present factors fit the present pose. No gradient to factors.
        """
        if not self.on:
            return rendering.colour
        with torch.no_grad():
            colour = rendering.colour.reshape(groups, -1, 3)
            wanted = target.reshape(groups, -1, 3)
            share = torch.ones_like(colour) if weight is None else weight.reshape(groups, -1, 1)
            gain = (share * colour * wanted).sum(1) / (share * colour**2).sum(1).clamp(min=1e-6)
            most = self._numbers.exposure_most
            gain = gain.clamp(1 / most, most).repeat_interleave(colour.shape[1], 0)
        return self._lit(rendering, gain)

    def _lit(self, rendering: Rendering, gain: Tensor) -> Tensor:
        if self._background is None:
            return gain * rendering.colour
        behind = (1 - rendering.opacity)[:, None] * self._background
        return gain * (rendering.colour - behind) + behind

    def forgiven(self, colour: Tensor, target: Tensor) -> Tensor:
        """`colour`, but the target where that is saturated and the colour brighter still, which is no error."""
        if not self.on:
            return colour
        return torch.where((target >= self._numbers.saturated) & (colour > target), target, colour)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """One step of Adam from the gradients of the last backward; `rate` is the networks'."""
        if self.log_gain.grad is None:
            return
        self.log_gain.grad += self._numbers.exposure_prior / len(self.log_gain) * self.log_gain
        self._adam.step(self._numbers.exposure_rate * rate)
        self._adam.zero_grad()
        mean = (self.log_gain * self._training).sum(0) / self._training.sum()
        most = math.log(self._numbers.exposure_most)
        self.log_gain.sub_(mean).clamp_(-most, most)

    @torch.no_grad()
    def forget(self, camera: int) -> None:
        """Reset one photo's factors, after its pose was replaced."""
        self.log_gain[camera] = 0
        self._adam.forget_row(camera)

    def gains(self) -> NDArray[np.float64] | None:
        """The factors [n, 3]; None without compensation."""
        return self.log_gain.detach().double().exp().cpu().numpy() if self.on else None

    def state(self) -> dict[str, Tensor]:
        return {"log_gain": self.log_gain.detach(), **self._adam.state("adam")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self.log_gain.copy_(state["log_gain"])
        self._adam.load_state("adam", state)

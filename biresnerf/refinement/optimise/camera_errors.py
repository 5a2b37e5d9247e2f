"""How well each camera agrees with the field, measured on the training batches; which ones stand out as lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.data.photos.images import ImageSet
from biresnerf.refinement.kernels.batches import add_errors
from biresnerf.refinement.numbers.optimise import ErrorNumbers

MAD_TO_DEVIATION = 1.4826
BACKGROUND_TOLERANCE = 0.05  # colours nearer to the background than this count as background
LEAST_FOREGROUND = 0.02


def foreground_shares(images: ImageSet) -> np.ndarray:
    """The share [n] of each photo that shows the scene: opaque, or unlike the background; 1 without background.

    Of the pixels that count, where there are masks.
    """
    shares = np.ones(len(images))
    if images.background is None:
        return shares
    for i in range(len(images)):
        alpha = images.alpha_image(i)
        if alpha is not None:
            shows = alpha / np.float32(255)
        else:
            difference = np.abs(images.image(i) / np.float32(255) - images.background).max(-1)
            shows = (difference > BACKGROUND_TOLERANCE).astype(np.float32)
        shares[i] = _counted(shows, images, i).mean()
    return np.maximum(shares, LEAST_FOREGROUND)


def _counted(values: np.ndarray, images: ImageSet, index: int) -> np.ndarray:
    """`values` [h, w, ...] at the pixels of image `index` that count, flattened."""
    counts = images.counts_image(index)
    return values.reshape(-1, *values.shape[2:]) if counts is None else values[counts]


def outliers(errors: Tensor, held_out: Tensor, numbers: ErrorNumbers) -> Tensor:
    """Mask [n] of the errors [n] that stand out.

    Held-out views, which the field never saw, are measured by their own median where there are enough of them;
    else they must exceed `stands_out_untrained` times that of the others.
    """
    training = errors[~held_out]
    median, spread = _middle(training)
    result = errors > torch.maximum(numbers.stands_out * median, median + numbers.deviations * spread)
    if bool(held_out.any()):
        factor, own = numbers.stands_out_untrained, errors[held_out]
        if len(own) >= numbers.own_yardstick_from:
            factor = numbers.stands_out
            own_median, own_spread = _middle(own)
            median, spread = torch.maximum(median, own_median), torch.maximum(spread, own_spread)
        bound = torch.maximum(factor * median, median + numbers.deviations * spread)
        result = torch.where(held_out, errors > bound, result)
    return result


def _middle(errors: Tensor) -> tuple[Tensor, Tensor]:
    """Median and robust standard deviation; both zero if there are no errors."""
    if len(errors) == 0:
        return errors.new_zeros(()), errors.new_zeros(())
    median = errors.median()
    return median, MAD_TO_DEVIATION * (errors - median).abs().median()


class CameraErrors:
    """Collects the squared errors of each camera's rays block by block (a block ends at each check).

    Errors are against the (blurred) targets and per ray that shows the scene, so that a small object does not
    make for a small error.

    Attributes:
        shares: see `foreground_shares`.
        errors: moving average [n] over blocks; infinite where there is none yet.
        doubted: mask [n] of cameras that began at a guess and have not yet agreed with the field of the others.
        lost: mask [n] of cameras that stood out for some blocks in a row, and of those in doubt.
        weights: of each camera's rays in the loss [n], None where all weigh the same.
        sums: of the present block [n, 3]: rays, squared errors, opacities.
    """

    def __init__(
        self,
        images: ImageSet,
        held_out: list[int],
        device: torch.device,
        numbers: ErrorNumbers = ErrorNumbers(),
    ) -> None:
        count, self._numbers = len(images), numbers
        self.shares = torch.from_numpy(foreground_shares(images)).float().to(device)
        variances = [
            _counted(images.image(i) / np.float32(255), images, i).var(0).mean() for i in range(count)
        ]
        # Per ray that shows the scene, as the errors are.
        self._variances = torch.tensor(variances, device=device) / self.shares
        self.bounded = images.background is not None
        self.held_out = torch.zeros(count, dtype=torch.bool, device=device)
        self.held_out[held_out] = True
        self.errors = torch.full((count,), torch.inf, device=device)
        self.weights: Tensor | None = None
        self.doubted = torch.zeros(count, dtype=torch.bool, device=device)
        self._stood_out = torch.zeros(count, dtype=torch.int64, device=device)
        self.sums = torch.zeros(count, 3, device=device)

    @property
    def lost(self) -> Tensor:
        return (self._stood_out >= self._numbers.in_a_row) | self.doubted

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Mask [n] of cameras that are no longer at a guessed pose."""
        return ~self.doubted.cpu().numpy()

    @property
    def suspects(self) -> Tensor:
        """Mask [n] of cameras that other poses should be tried for: the lost ones, and those that nearly are."""
        numbers = self._numbers
        looser = replace(
            numbers, deviations=numbers.suspect_deviations, stands_out_untrained=numbers.stands_out
        )
        return self.lost | self._outliers(looser)

    @property
    def relative(self) -> Tensor:
        """Errors [n] over the median of the training cameras; infinite where there is none yet."""
        known = self.errors[~self.held_out & self.errors.isfinite()]
        return self.errors / known.median().clamp(min=1e-12) if len(known) else self.errors

    def _weigh(self) -> None:
        """Weigh lost cameras less: they must not fog the field where they wrongly stand."""
        self.weights = None
        if bool(self.lost.any()):
            known = self.errors.isfinite()
            weights = torch.where(known, 1 / self.relative.clamp(min=1), torch.ones_like(self.errors))
            weights = torch.where(self.doubted, weights.clamp(max=self._numbers.doubted_weight), weights)
            self.weights = torch.where(self.lost, weights, torch.ones_like(weights))

    def doubt(self, cameras: np.ndarray) -> None:
        """Mark cameras (mask [n]) with guessed poses: they begin with little weight, and as suspects."""
        self.doubted.copy_(torch.from_numpy(cameras))
        self._weigh()

    def believe(self, camera: int) -> None:
        """Note that the camera agrees with the field of the others."""
        self.doubted[camera] = False
        self._weigh()

    def add(self, image: Tensor, colour: Tensor, target: Tensor, opacity: Tensor, weight: Tensor) -> None:
        """Add a batch: image, opacity and weight [rays], rendered and target colours [rays, 3]."""
        if self.sums.device.type != "cpu":
            self.defined_add(image, colour, target, opacity, weight)
            return
        shown, wanted = colour.contiguous().numpy(), target.contiguous().numpy()
        add_errors(image.numpy(), shown, wanted, opacity.numpy(), weight.numpy(), self.sums.numpy())

    def defined_add(
        self, image: Tensor, colour: Tensor, target: Tensor, opacity: Tensor, weight: Tensor
    ) -> None:
        """The same by torch's operations, on any device."""
        squared = ((colour - target) ** 2).mean(1)
        values = torch.stack([torch.ones_like(squared), squared, opacity], 1)
        self.sums.index_add_(0, image, values * weight[:, None])

    def close_block(self) -> None:
        """Add the block's errors to the moving average and find the cameras that stand out."""
        rays, squared, opacity = self.sums.unbind(1)
        measured = rays > 0
        block = squared / rays.clamp(min=1) / self.shares
        newest = self._numbers.smoothing
        smoothed = torch.where(self.errors.isfinite(), self.errors + newest * (block - self.errors), block)
        self.errors = torch.where(measured, smoothed, self.errors)
        out = self._outliers(self._numbers)
        if 0 < int(self.held_out.sum()) < self._numbers.own_yardstick_from:
            out &= ~self.held_out | (self.errors > self._numbers.unexplained_untrained * self._variances)
        if self.bounded:
            out |= measured & (opacity / rays.clamp(min=1) < self._numbers.coverage * self.shares)
        self._stood_out = torch.where(out, self._stood_out + 1, torch.zeros_like(self._stood_out))
        self.sums.zero_()
        self._weigh()

    def _outliers(self, numbers: ErrorNumbers) -> Tensor:
        known = self.errors.isfinite()
        out = torch.zeros_like(known)
        out[known] = outliers(self.errors[known], self.held_out[known], numbers)
        return out & (self.errors > self._numbers.unexplained * self._variances)

    def forget(self, camera: int) -> None:
        """Reset one camera, after its pose was replaced."""
        self.errors[camera] = torch.inf
        self._stood_out[camera] = 0
        self.doubted[camera] = False
        self.sums[camera] = 0
        self._weigh()

    def state(self) -> dict[str, Tensor]:
        return {
            "errors": self.errors,
            "stood_out": self._stood_out,
            "sums": self.sums.T,
            "doubted": self.doubted,
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        for name, tensor in self.state().items():
            tensor.copy_(state[name])
        self._weigh()

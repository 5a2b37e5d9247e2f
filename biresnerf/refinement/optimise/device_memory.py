"""Steps on a GPU whose memory may be too small for the batch that the options request."""

from __future__ import annotations

import logging

import torch

from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser, StepResult

logger = logging.getLogger(__name__)

# Of the requested samples: if even these do not fit, batches are not the cause.
LEAST_SHARE = 1 / 16


def step_that_fits(optimiser: JointOptimiser) -> StepResult:
    """Take a step of the joint optimisation. Once a GPU's memory proves too small, steps have half of the samples.

    Gradients of exposures and poses from a failed step add to the next one's: they sample the same gradient.

    Raises:
        torch.OutOfMemoryError: not even a sixteenth of the samples fit.
    """
    while True:
        try:
            return optimiser.step()
        except torch.OutOfMemoryError:
            if optimiser.batch_share <= LEAST_SHARE:
                raise
        # After the handler, as the error's traceback holds the step's tensors.
        optimiser.halve_batch()
        torch.cuda.empty_cache()
        logger.warning("%s", smaller_batches(optimiser.batch_share, optimiser.options.samples_per_step)[0])


def smaller_batches(share: float, samples: int) -> tuple[str, ...]:
    """A warning where batches of so many samples did not fit, and only a share of them was used."""
    if share == 1:
        return ()
    return (
        f"The GPU's memory is too small for samples_per_step={samples}: steps had "
        f"{share:.2g} of these samples. Poses may be less exact.",
    )

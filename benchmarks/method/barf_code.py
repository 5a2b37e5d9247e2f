"""Checks our code against BARF's: ``python -m benchmarks.method.barf_code CHECKOUT SET``.

CHECKOUT is a clone of https://github.com/chenhsuanlin/bundle-adjusting-NeRF. It gets our weights and noisy poses, and
the same pixels and depths of SET. Prints the largest differences of colours, and of gradients of the loss by poses and
weights, relative to the largest value, at four points of the run. `rounding` is that of our poses' gradient if all
cameras move by a ten-millionth of their distance.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import torch
from torch import Tensor

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.field.radiance_field import PositionGradient
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.options.refine_options import parse_options
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.studies.baselines.methods import BARF_HIDDEN, BARF_SAMPLES
from biresnerf.studies.baselines.mlp_field import LAYERS, POSITION_BANDS, SKIP, VIEW_BANDS, MlpField

# Imported for its logs, figures and scores, none of which are used here.
UNUSED = (
    "easydict", "external", "external.pohsun_ssim", "ipdb", "lpips", "matplotlib", "matplotlib.pyplot", "termcolor",
    "torch.utils.tensorboard", "torchvision", "torchvision.transforms", "torchvision.transforms.functional", "tqdm",
    "util_vis", "visdom",
)  # fmt: skip
PROGRESS = (0.0, 0.2, 0.35, 1.0)  # closed, two states on the way, open
RAYS, IMAGES, SIZE, NOISE = 64, 4, 50, 0.15
ROUNDING = 1e-7  # what float32 does to positions


def published_code(checkout: Path) -> tuple[ModuleType, ModuleType]:
    """The published modules `model.barf` and `camera`."""
    for name in UNUSED:
        sys.modules[name] = MagicMock()
    sys.path.insert(0, str(checkout))
    import importlib

    return importlib.import_module("model.barf"), importlib.import_module("camera")


def published_options() -> Any:
    """The published options for Blender scenes (options/nerf_blender.yaml, barf_blender.yaml): network and renderer."""
    return SimpleNamespace(
        device="cpu",
        arch=SimpleNamespace(
            layers_feat=[None, *[BARF_HIDDEN] * LAYERS], layers_rgb=[None, BARF_HIDDEN // 2, 3], skip=[SKIP],
            posenc=SimpleNamespace(L_3D=POSITION_BANDS, L_view=VIEW_BANDS), density_activ="softplus", tf_init=True,
        ),
        nerf=SimpleNamespace(view_dep=True, density_noise_reg=None, setbg_opaque=False),
        data=SimpleNamespace(bgcolor=1),
        camera=SimpleNamespace(model="perspective", ndc=False),
        barf_c2f=[0.1, 0.5], H=SIZE, W=SIZE,
    )  # fmt: skip


def relative(ours: Tensor, theirs: Tensor) -> float:
    return float((ours - theirs).abs().max() / theirs.abs().max())


def ours(optimiser: JointOptimiser, image: Tensor, xy: Tensor, photo: Tensor) -> dict[str, Tensor]:
    """Colours [rays, 3] and gradients of the loss, of samples in the middles of their bins."""
    matrices = optimiser.poses.matrices()[image]
    renderer = optimiser.renderer
    rays = renderer.over_background(*renderer.cast(matrices, image, xy), len(xy), jitter=False)
    colour = renderer.field.render(rays, renderer.marching, PositionGradient()).colour
    optimiser.method.loss(colour, photo).mean().backward()
    poses = optimiser.poses
    assert isinstance(optimiser.field, MlpField)
    assert poses.rotation.grad is not None
    assert poses.translation.grad is not None
    # Ours is the increment of world from camera, theirs of camera from world.
    found = {
        "colours": colour.detach(),
        "poses": -torch.cat([poses.rotation.grad, poses.translation.grad], 1),
        "weights": torch.cat([p.grad.reshape(-1) for p in optimiser.field.parameters if p.grad is not None]),
    }
    found = {name: value.clone() for name, value in found.items()}
    poses.rotation.grad = poses.translation.grad = None
    optimiser.field.discard_gradients()
    return found


def theirs(
    barf: ModuleType, camera: ModuleType, optimiser: JointOptimiser, image: Tensor, xy: Tensor, photo: Tensor
) -> dict[str, Tensor]:
    """The same from the published code."""
    options, field = published_options(), optimiser.field
    assert isinstance(field, MlpField)
    network = barf.NeRF(options)
    layers = [*network.mlp_feat, *network.mlp_rgb]
    with torch.no_grad():
        for i, layer in enumerate(layers):
            layer.weight.copy_(field.parameters[2 * i])
            layer.bias.copy_(field.parameters[2 * i + 1])
    network.progress.data.fill_(field.progress)
    start = optimiser.poses.start
    turn = start[:, :, :3].transpose(1, 2)
    given = camera.pose(R=turn, t=-(turn @ start[:, :, 3:])[:, :, 0] / field.length)
    increments = torch.zeros(len(given), 6, requires_grad=True)
    poses = camera.pose.compose([camera.lie.se3_to_SE3(increments), given])
    lens = optimiser.lenses.intrinsics
    matrix = torch.zeros(len(given), 3, 3)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2] = lens.fx, lens.fy, 1.0
    matrix[:, 0, 2], matrix[:, 1, 2] = lens.cx, lens.cy
    centre, ray = camera.get_center_and_ray(options, poses, intr=matrix)
    pixel = xy[:, 1].long() * SIZE + xy[:, 0].long()
    centre, ray = (each[image, pixel][None] for each in (centre, ray))
    marching = optimiser.marching(optimiser.schedule.fine_interval)
    middles = (torch.arange(BARF_SAMPLES) + 0.5) / BARF_SAMPLES
    along = (marching.near + middles * (marching.far - marching.near)) / field.length
    depth = along[None, None, :, None] / ray.norm(dim=-1)[:, :, None, None].detach()
    colour, density = network.forward_samples(options, centre, ray, depth)
    rendered = network.composite(options, ray, colour, density, depth)[0][0]
    ((rendered - photo) ** 2).mean().backward()
    assert increments.grad is not None
    return {
        "colours": rendered.detach(),
        "poses": increments.grad,
        "weights": torch.cat([p.grad.reshape(-1) for layer in layers for p in (layer.weight, layer.bias)]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkout", type=Path)
    parser.add_argument("set", type=Path)
    asked = parser.parse_args()
    barf, camera = published_code(asked.checkout)
    dataset = read_dataset(asked.set)
    images = load_images(dataset, SIZE)
    noisy = perturb_poses(dataset.world_from_cam, NOISE, seed=1)
    frame = scene_frame(noisy, images, FrameNumbers())
    options = parse_options({"preset": "fast", "method": "barf", "max_image_size": SIZE}).resolved("cpu")
    recipe = Recipe.of(options, torch.device("cpu"), 1)
    optimiser = JointOptimiser(images, frame, frame.unit_from_world.apply_to_poses(noisy), recipe, [])
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(IMAGES, (RAYS,), generator=generator)
    xy = torch.randint(SIZE, (RAYS, 2), generator=generator) + 0.5
    photo = torch.stack(
        [
            torch.from_numpy(images.image(int(i))[int(y), int(x)] / 255)
            for i, (x, y) in zip(image, xy, strict=True)
        ]
    ).float()
    for progress in PROGRESS:
        optimiser.field.reach(progress)
        mine = ours(optimiser, image, xy, photo)
        published = theirs(barf, camera, optimiser, image, xy, photo)
        line = {name: relative(mine[name], published[name]) for name in mine}
        kept = optimiser.poses.start.clone()
        optimiser.poses.start[:, :, 3] *= 1 + ROUNDING
        line["rounding"] = relative(ours(optimiser, image, xy, photo)["poses"], mine["poses"])
        optimiser.poses.start.copy_(kept)
        print(
            json.dumps({"progress": progress, **{k: float(f"{v:.1e}") for k, v in line.items()}}), flush=True
        )


if __name__ == "__main__":
    main()

"""transforms.json as a format: found by name, read, and written in the input's own dialect."""

from __future__ import annotations

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.transforms.read_transforms import bind_transforms, parse_transforms
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.options.formats import Format

TRANSFORMS = Format(
    name="transforms",
    title="transforms.json (nerfstudio, instant-ngp, Blender)",
    rank=10,
    found_as=("transforms.json", "transforms_train.json"),
    suffixes=(".json",),
    gives="poses (also for some images only), shared or per-frame intrinsics, masks",
    checked_against="hand-made files of each dialect; published sets",
    in_set="transforms.json",
    in_result="transforms.json",
    always=True,
    needs=("input",),
    loses=("rigs", "points"),
    heading="For nerfstudio",
    hint="Replaces the transforms.json of the photos; then: ns-train nerfacto --data FOLDER",
)
CODECS = (
    Codec(
        TRANSFORMS,
        parse=parse_transforms,
        bind=bind_transforms,
        write=lambda refined, path, context: (
            None
            if context.dataset is None
            else write_transforms(context.dataset, refined.world_from_cam, path)
        ),
    ),
)

"""What schemathesis sends where the document says no more than `binary`: loaded by it, see `fuzzing`."""

from __future__ import annotations

import tempfile
from pathlib import Path

import schemathesis
from hypothesis import strategies

from biresnerf.data.synthetic.scene import write_synthetic_scene
from tests.service.conftest import scene_files, zip_of

with tempfile.TemporaryDirectory() as folder:
    write_synthetic_scene(Path(folder), n_views=6, size=32, seed=1)
    GOOD = zip_of(scene_files(Path(folder)))

# Mostly a set that can be refined, so that chains of calls get beyond the upload.
_ARCHIVES = strategies.one_of(
    strategies.just(GOOD),
    strategies.just(GOOD),
    strategies.just(GOOD[:-40]),
    strategies.just(zip_of({"../evil.png": b"x"})),
    strategies.binary(max_size=200),
)
_ALIASES = ["application/x-tar", "application/gzip", "application/offset+octet-stream"]
schemathesis.openapi.media_type("application/zip", _ARCHIVES, aliases=_ALIASES)

"""Damaged photos and videos are read or refused by name; they neither crash a process nor fill its memory."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.data.photos.kinds.test_photo_kinds import exif, picture, write
from tests.data.photos.video.filmed import film

pytestmark = pytest.mark.nightly

COUNT = 60  # of each kind
KINDS = (".jpg", ".png", ".webp", ".bmp", ".tiff", ".heic", ".avif", ".dng", ".exr", ".tif", ".hdr", ".mp4")
LONGEST_S, MOST_MB = 60.0, 1500


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_or_refused_by_name(kind: str, tmp_path: Path) -> None:
    source = tmp_path / f"photo{kind}"
    if kind == ".mp4":
        film(source, np.arange(20) * 2.0, [False] * 20)
    elif kind in (".jpg", ".png", ".webp", ".bmp", ".tiff"):
        Image.fromarray(picture()).save(source, **({} if kind in (".bmp", ".tiff") else {"exif": exif()}))
    else:
        write(source, picture())
    seed = random.SystemRandom().randrange(1 << 30)
    command = [sys.executable, "-m", "tests.data.photos.damaged", str(tmp_path), str(seed), str(COUNT)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=900)
    lines = [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    assert ran.returncode == 0, (seed, lines[-1], ran.stderr[-2000:])
    tries = [line for line in lines if "outcome" in line]
    assert len(tries) == COUNT
    assert [line for line in tries if not line["outcome"].replace("_", "").isalpha()] == [], seed
    assert [line for line in tries if line["s"] > LONGEST_S] == []
    assert lines[-1]["peak_mb"] < MOST_MB
    refused = sum(line["outcome"] != "read" for line in tries)
    assert refused > 0, "the damage does something"

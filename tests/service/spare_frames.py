"""Sets of only three frames, so that one bad frame makes the whole set refused."""

from __future__ import annotations

import json


def three_frames(files: dict[str, bytes]) -> dict[str, bytes]:
    """The first three frames of a made scene, and their photos."""
    document = json.loads(files["transforms.json"])
    document["frames"] = document["frames"][:3]
    photos = {frame["file_path"].removeprefix("./") + ".png" for frame in document["frames"]}
    kept = {name: content for name, content in files.items() if not name.endswith(".png") or name in photos}
    return {**kept, "transforms.json": json.dumps(document).encode()}

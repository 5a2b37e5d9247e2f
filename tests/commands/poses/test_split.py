"""`biresnerf split` writes lists of photos that `refine` reads, and prints the commands."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from click.testing import CliRunner

from biresnerf.commands.poses.split import split_command
from biresnerf.commands.settings_option import parse_settings
from biresnerf.data.formats.read_dataset import read_dataset
from tests.data.scenes import write_image


def test_the_printed_commands_name_every_photo_and_the_folder_that_is_joined(tmp_path: Path) -> None:
    scene, parts = tmp_path / "my scene", tmp_path / "parts"
    for index in range(50):
        write_image(scene / f"{index:03}.png", seed=index // 10)
    asked = [str(scene), "--output", str(parts), "--most", "25"]
    result = CliRunner().invoke(split_command, [*asked, "--set", "leave_out=007.png", "--json"])
    assert result.exit_code == 0, (result.output, result.exception)
    found = json.loads(result.stdout)
    seen, results = set(), set()
    for command, part in zip(found["refine"], found["parts"], strict=True):
        words = shlex.split(command)
        assert words[:3] == ["biresnerf", "refine", str(scene)]
        assert parse_settings((words[words.index("--set") + 1],)) == {"leave_out": ["007.png"]}
        names = Path(words[words.index("--photos-from") + 1]).read_text("utf-8").splitlines()
        assert len(names) == part["photos"]
        seen |= set(names)
        results.add(Path(words[words.index("--output") + 1]))
    assert seen == set(read_dataset(scene).names) - {"007.png"}
    assert len(results) == len(found["parts"]) > 1
    joined = shlex.split(found["join"])
    assert "--set" in joined
    assert {one.parent for one in results} == {Path(joined[joined.index("--join") + 1])}
    again = CliRunner().invoke(split_command, asked)
    assert getattr(again.exception, "code", "") == "output_not_empty"

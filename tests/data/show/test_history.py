"""The curve of a run: one line per check, consistent after a kill."""

from __future__ import annotations

import json

from biresnerf.data.show.history import HISTORY, History, read_history
from biresnerf.progress import Monitor
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from tests.refinement.tiny_scene import TinyRun, finished, given_scene, tiny_optimiser, tiny_options, tiny_set


def test_each_check_leaves_a_line_and_a_continued_run_has_them_once(tmp_path):
    scene, options = tiny_set(tmp_path / "scene"), tiny_options()

    def run(stop_at: int) -> TinyRun:
        optimiser = tiny_optimiser(*scene, options)
        found = TinyRun(
            optimiser,
            given_scene(*scene),
            tmp_path,
            Monitor(should_stop=lambda: optimiser.step_index >= stop_at),
            at_check=lambda _poses: {"observed": float(optimiser.step_index)},
        )
        checkpoint = load_checkpoint(tmp_path)
        if checkpoint is not None:
            found.stages.restore(checkpoint)
        finished(found)
        return found

    run(13)
    # As a kill leaves it: lines from after the checkpoint, the last one torn off.
    with (tmp_path / HISTORY).open("a") as file:
        file.write(json.dumps({"step": 15, "stage": "lost"}) + '\n{"step": 20, "sta')
    whole = run(10_000)
    seen = read_history(tmp_path / HISTORY)
    assert [line["step"] for line in seen] == list(range(5, 41, 5))
    assert [line["stage"] for line in seen] == ["coarse"] * 4 + ["fine"] * 4
    assert whole.optimiser.switch == 20
    assert all(line["observed"] == line["step"] for line in seen)
    assert all(line["reconstruction_rate"] == 0 for line in seen[:4])
    assert seen[-1]["reconstruction_rate"] > 0
    assert seen[-1]["pose_rate"] == 0  # frozen at the end
    assert all(line["samples"] >= line["rays"] > 0 for line in seen)


def test_a_run_from_the_start_drops_what_an_older_one_left(tmp_path):
    history = History(tmp_path)
    history.append({"step": 5, "stage": "coarse"})
    history.cut(0)
    history.append({"step": 5, "stage": "coarse", "psnr": 20.0})
    assert read_history(history.path) == [{"step": 5, "stage": "coarse", "psnr": 20.0}]

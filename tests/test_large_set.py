"""The made set of many photos is read as one, and its profiler's seconds go to the right parts."""

from __future__ import annotations

import cProfile
import pstats
import time

from benchmarks.speed import large_set, large_set_run
from biresnerf.data.formats.read_dataset import read_dataset


def test_each_count_is_a_set_of_photos_of_12_mp_spread_over_all(tmp_path):
    files = large_set.make_set(tmp_path / "set", [3, 5])
    sets = {count: read_dataset(path) for count, path in files.items()}
    assert [len(dataset) for dataset in sets.values()] == [3, 5]
    assert [frame.path.name for frame in sets[3].frames] == ["0000.jpg", "0002.jpg", "0004.jpg"]
    assert (sets[5].camera_of(0).width, sets[5].camera_of(0).height) == (4000, 3000)
    assert sets[5].posed.all()


def slow() -> None:
    time.sleep(0.02)


def counted() -> None:
    slow()


def beside() -> None:
    slow()
    slow()


def test_a_function_counts_only_where_the_named_one_calls_it(monkeypatch):
    profiler = cProfile.Profile()
    profiler.runcall(lambda: (counted(), beside()))
    stats = pstats.Stats(profiler)
    function, caller = ("test_large_set.py", "slow"), ("test_large_set.py", "counted")
    everywhere = large_set_run.seconds_in(stats, function)
    monkeypatch.setitem(large_set_run.CALLED_BY, function, caller)
    assert 0 < large_set_run.seconds_in(stats, function) < everywhere
    monkeypatch.setitem(large_set_run.CALLED_BY, function, ("test_large_set.py", "nobody"))
    assert large_set_run.seconds_in(stats, function) == 0

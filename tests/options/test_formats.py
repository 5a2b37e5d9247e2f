"""Declarations of formats: read without loading their modules, and equal to the modules' own."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.options.formats import formats


def test_the_declarations_are_those_of_the_modules_that_read_and_write():
    assert list(ALL_CODECS) == list(formats())
    for name, codec in ALL_CODECS.items():
        assert replace(codec.format, module=formats()[name].module) == formats()[name]


def test_declarations_are_read_without_numpy_and_without_any_reader():
    code = (
        "import sys; from biresnerf.options.formats import formats; assert len(formats()) > 10; "
        "assert not [name for name in sys.modules if name == 'numpy' or name.startswith('biresnerf.data')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_format_that_has_names_in_folders_is_read_and_one_that_has_a_place_is_written():
    ranks = [one.rank for one in formats().values()]
    assert len(set(ranks)) == len(ranks)
    for name, codec in ALL_CODECS.items():
        assert (codec.parse is not None) == bool(codec.format.found_as), name
        assert (codec.write is not None) == bool(codec.format.in_set or codec.format.in_result), name


def test_everything_that_is_written_says_for_whom_and_everything_that_is_read_what_it_gives():
    for one in formats().values():
        assert bool(one.heading and one.hint) == bool(one.in_result), one.name
        assert bool(one.gives and one.checked_against) == bool(one.found_as), one.name

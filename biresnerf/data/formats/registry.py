"""All formats with the functions that read and write them, found by their declarations."""

from __future__ import annotations

from importlib import import_module

from biresnerf.data.formats.codec import Codec
from biresnerf.options.formats import formats


def _all_codecs() -> dict[str, Codec]:
    modules = [import_module(name) for name in dict.fromkeys(one.module for one in formats().values())]
    found = {codec.format.name: codec for module in modules for codec in module.CODECS}
    return {name: found[name] for name in formats()}


# By the format's name, in the order of the formats' ranks. A new module with a declaration adds its own.
ALL_CODECS = _all_codecs()

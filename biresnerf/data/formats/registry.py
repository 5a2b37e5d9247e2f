"""All formats with the functions that read and write them, found by their declarations."""

from __future__ import annotations

from functools import cache
from importlib import import_module

from biresnerf.data.formats.codec import Codec
from biresnerf.options.formats import formats


@cache
def codecs() -> dict[str, Codec]:
    """By the format's name, in the order of the formats' ranks. Adding a module with a declaration adds it here."""
    modules = [import_module(name) for name in dict.fromkeys(one.module for one in formats().values())]
    found = {codec.format.name: codec for module in modules for codec in module.CODECS}
    return {name: found[name] for name in formats()}

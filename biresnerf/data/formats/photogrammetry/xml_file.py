"""XML of unknown origin: bounded, and without entities, so that nothing can expand."""

from __future__ import annotations

import xml.parsers.expat
from pathlib import Path
from xml.etree import ElementTree

from biresnerf.data.model.untrusted_file import invalid_file, read_text

_MAX_DEPTH, _MAX_ELEMENTS = 50, 500_000


class _Builder(ElementTree.TreeBuilder):
    """A tree that is neither too deep nor too large."""

    depth = elements = 0

    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        self.depth, self.elements = self.depth + 1, self.elements + 1
        if self.depth > _MAX_DEPTH or self.elements > _MAX_ELEMENTS:
            raise ElementTree.ParseError("nested too deeply, or too long")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)


def read_xml(file: Path, hint: str) -> ElementTree.Element:
    """The root of the XML ``file``. Raises InputError ``pose_file_invalid``, also for document types and entities."""
    text = read_text(file)
    try:
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ElementTree.ParseError("document types and entities are not read")
        return ElementTree.fromstring(text, parser=ElementTree.XMLParser(target=_Builder()))
    except (ElementTree.ParseError, xml.parsers.expat.ExpatError, ValueError) as error:
        raise invalid_file(file.name, f"is no XML that is read: {error}.", hint) from None

"""What the page reads of the service's answers is there: by docs/openapi.json, which another test keeps true."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = json.loads((ROOT / "docs" / "openapi.json").read_text())["components"]["schemas"]
SOURCE = (ROOT / "service" / "web" / "service" / "answers.ts").read_text()
# Of JSON Schema itself, and what a check found, which the document leaves open.
FREE = {"Schema", "CheckReport"}
INTERFACES = {
    name: re.findall(r"^  (\w+)\??:", body, re.M)
    for name, body in re.findall(r"export interface (\w+) \{\n(.*?)\n\}", SOURCE, re.S)
    if name not in FREE
}


@pytest.mark.parametrize("name", INTERFACES)
def test_every_field_that_the_page_reads_is_declared(name: str) -> None:
    assert INTERFACES[name]
    assert set(INTERFACES[name]) <= set(SCHEMAS[name]["properties"])

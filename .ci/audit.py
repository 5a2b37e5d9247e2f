"""Checks the pinned libraries for known vulnerabilities, as far as an index lists them.

`python .ci/audit.py TOOLS`: exit status 1 if a library has a known fault. Libraries that could not be looked up (no
network, an index without advisories) are skipped and named.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ANSWER_S = 180


def asked(tools: Path) -> dict[str, Any] | None:
    """The findings of pip-audit; None if it could not look anything up."""
    command = [tools / "bin/pip-audit", "--requirement", "constraints.txt", "--no-deps", "--disable-pip"]
    try:
        done = subprocess.run(
            [*command, "--format", "json", "--progress-spinner", "off", "--timeout", "10"],
            capture_output=True,
            text=True,
            timeout=ANSWER_S,
        )
        return dict(json.loads(done.stdout))
    except (OSError, subprocess.TimeoutExpired, ValueError) as error:
        sys.stdout.write(f"skipped: the advisories cannot be reached ({type(error).__name__})\n")
        return None


def judged(found: dict[str, Any]) -> int:
    """The exit status for the findings, which are printed."""
    libraries = found["dependencies"]
    skipped = [library["name"] for library in libraries if "skip_reason" in library]
    if skipped:
        names = "any library" if len(skipped) == len(libraries) else ", ".join(skipped)
        sys.stdout.write(f"skipped: the index has no advisories of {names}\n")
    bad = [library for library in libraries if library.get("vulns")]
    for library in bad:
        for fault in library["vulns"]:
            mended = ", ".join(fault["fix_versions"]) or "no version"
            sys.stdout.write(f"{library['name']} {library['version']}: {fault['id']}, mended in {mended}\n")
    sys.stdout.write(f"{len(libraries) - len(skipped)} libraries looked up, {len(bad)} with a known fault\n")
    return 1 if bad else 0


def main() -> int:
    """Run the audit; returns the exit status."""
    found = asked(Path(sys.argv[1]))
    return 0 if found is None else judged(found)


if __name__ == "__main__":
    sys.exit(main())

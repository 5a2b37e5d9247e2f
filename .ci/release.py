"""`make release`: builds the wheel and the source distribution in build/release, checks and describes them.

Uses only the last commit: the source distribution is built from a clean copy, the wheel from the source distribution,
without Node. The wheel is then installed alone into a fresh environment of each given Python, where it refines a
synthetic scene: `python .ci/release.py PYTHON...`.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from email.parser import BytesParser
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "release"
PACKAGES = {"biresnerf", "service", "workers"}
IN_WHEEL = (
    "biresnerf/py.typed",
    "biresnerf/viewer/dist/report.js",
    "service/web/dist/index.html",
    "service/example/report.json",
)
QUICK_START = (
    ("make-scene", "scene", "--views", "12", "--size", "64", "--seed", "1"),
    ("refine", "scene", "--output", "out", "--preset", "fast", "--set", "steps=200", "--set", "start=given"),
    ("evaluate", "out", "scene.truth.json"),
)


def main(pythons: list[str]) -> None:
    """Make and check a release; raises `SystemExit` that says what is wrong."""
    OUT.mkdir(parents=True, exist_ok=True)
    for old in OUT.iterdir():
        old.unlink()
    if run("git", "status", "--porcelain", cwd=ROOT):
        raise SystemExit("There are changes that are not committed; a release is made of commits.")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "source")
        run("git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(source))
        run(sys.executable, "-m", "build", "--outdir", str(OUT), str(source))
    wheel, sdist = next(OUT.glob("*.whl")), next(OUT.glob("*.tar.gz"))
    run(sys.executable, "-m", "twine", "check", "--strict", str(wheel), str(sdist))
    version = check_contents(wheel, sdist)
    for python in pythons:
        try_alone(python, wheel)
    describe(version, (wheel, sdist))


def check_contents(wheel: Path, sdist: Path) -> str:
    """Check that both hold what they should, and nothing else; returns the version."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = next(name for name in names if name.endswith(".dist-info/METADATA"))
        version = BytesParser().parsebytes(archive.read(metadata))["Version"]
    tops = {name.split("/")[0] for name in names} - {f"biresnerf-{version}.dist-info"}
    lacking = [name for name in IN_WHEEL if name not in names]
    if tops != PACKAGES or lacking:
        raise SystemExit(f"{wheel.name} has {sorted(tops)} at its top, and lacks {lacking}.")
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    if lacking := [name for name in (*IN_WHEEL, "hatch_build.py", "LICENSE") if name not in held]:
        raise SystemExit(f"{sdist.name} lacks {lacking}.")
    if not re.search(rf"^## \[{re.escape(version)}\]", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M):
        raise SystemExit(f"CHANGELOG.md has no section on {version}.")
    return str(version)


def try_alone(python: str, wheel: Path) -> None:
    """Install the wheel and the pinned libraries into a fresh environment, and refine a small synthetic scene there."""
    with tempfile.TemporaryDirectory() as folder:
        run(python, "-m", "venv", f"{folder}/alone")
        # Only this Python on the path: no Node, no git, no compiler.
        environment = {"PATH": f"{folder}/alone/bin", "HOME": folder, "LANG": "C.UTF-8"}
        environment |= {
            name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))
        }
        environment["PIP_CONSTRAINT"] = str(ROOT / "constraints.txt")
        run("python", "-m", "pip", "install", "--quiet", str(wheel), cwd=folder, env=environment)
        for command in QUICK_START:
            run("biresnerf", *command, cwd=folder, env=environment)
        version = run("python", "--version", cwd=folder, env=environment).strip()
    print(f"{version}: installed alone, refined a scene")


def describe(version: str, files: tuple[Path, ...]) -> None:
    """Print sizes and digests, and write the digests beside the files."""
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files]
    (OUT / "SHA256SUMS").write_text("".join(lines))
    print(f"{version} in {OUT.relative_to(ROOT)}:")
    for path in files:
        print(f"  {path.name}  {path.stat().st_size / 2**20:.1f} MiB")
    print("".join(lines), end="")


def run(*command: str, cwd: Path | str | None = None, env: dict[str, str] | None = None) -> str:
    """Run a program; returns its output, raises `SystemExit` if it fails."""
    path = (env or os.environ).get("PATH", "")
    program = next(
        (f"{part}/{command[0]}" for part in path.split(":") if os.access(f"{part}/{command[0]}", os.X_OK)),
        command[0],
    )
    ended = subprocess.run(
        [program, *command[1:]], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise SystemExit(
            f"{' '.join(command)} ended with {ended.returncode}:\n{ended.stdout[-2000:]}{ended.stderr[-2000:]}"
        )
    return ended.stdout


if __name__ == "__main__":
    main(sys.argv[1:])

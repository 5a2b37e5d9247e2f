"""Runs a program that dies with its parent: `python die_with_parent.py PARENT_PID SIGNAL USER NICE COMMAND…`.

A separate program (standard library only, started by path) instead of a ``preexec_fn``, because Python code
between fork and exec can deadlock in a process that has threads. USER is a user name, or ``-`` for no change. NICE
is added to its nice value.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pwd
import sys

PR_SET_PDEATHSIG = 1


def main(arguments: list[str]) -> None:
    """Change user and priority, tie this process to its parent, become the command."""
    parent, signal_number, user, nice = int(arguments[0]), int(arguments[1]), arguments[2], int(arguments[3])
    command = arguments[4:]
    if user != "-":
        entry = pwd.getpwnam(user)
        os.setgroups([])
        os.setgid(entry.pw_gid)
        os.setuid(entry.pw_uid)
        os.environ["HOME"] = entry.pw_dir
    # After the change of user: the kernel clears the setting when credentials change.
    if (
        sys.platform == "linux"
        and ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal_number) != 0
    ):
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:  # it died before we were tied to it
        os._exit(1)
    _give_way(nice)
    os.execvp(command[0], command)


def _give_way(nice: int) -> None:
    if nice == 0:
        return
    value = os.nice(nice)
    # Linux may schedule each session as a group (sched(7), autogroup). Then a nice value counts only within the
    # session, and the group has a separate one.
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError), open("/proc/self/autogroup", "w") as group:
            group.write(str(value))


def dying_with_parent(
    command: list[str], *, signal_number: int, user: str | None = None, nice: int = 0
) -> list[str]:
    """The command line that runs ``command`` so that it dies with this process, with ``nice`` added.

    Start it in its own session if it is to give way to processes of other sessions.
    """
    return [
        *(sys.executable, "-I", "-S", os.path.abspath(__file__)),
        *(str(os.getpid()), str(signal_number), user or "-", str(nice)),
        *command,
    ]


if __name__ == "__main__":
    main(sys.argv[1:])

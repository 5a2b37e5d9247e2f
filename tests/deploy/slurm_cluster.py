"""A Slurm cluster of one node as processes of this one: munged, slurmctld and slurmd, with files of their own."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.service.free_port import free_port

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "scancel")
PATIENCE_S = 60.0
NODE = "node0"
# A cluster of a real size has such a node a hundred times; its silence is noticed after minutes, not seconds.
CONFIGURATION = """
ClusterName=check
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmctldPort={controller_port}
SlurmdPort={node_port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MailProg=/bin/true
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_min_interval=0,batch_sched_delay=0,sched_interval=2,bf_interval=2
SlurmdTimeout=5
ReturnToService=2
KillWait=30
SlurmdParameters=config_overrides
NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory=64000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def lacking() -> list[str]:
    """Programs of Slurm and munge that are not installed."""
    return [name for name in PROGRAMS if shutil.which(name) is None]


class SlurmCluster:
    """Use as a context manager; ``variables`` make Slurm's commands talk to it."""

    def __init__(self, folder: Path, cpus: int) -> None:
        self._folder, self._cpus = folder, cpus
        self._configuration = folder / "slurm.conf"
        self.variables = {**os.environ, "SLURM_CONF": str(self._configuration)}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> SlurmCluster:
        for name in ("state", "spool"):
            (self._folder / name).mkdir()
        key, socket = self._folder / "munge.key", self._folder / "munge.socket"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        ports = {"controller_port": free_port(), "node_port": free_port()}
        about = {"host": platform.node(), "folder": self._folder, "node": NODE, "cpus": self._cpus}
        self._configuration.write_text(CONFIGURATION.format(**ports, **about))
        names = ("pid", "log", "seed")
        own = [f"--{name}-file={self._folder}/munged.{name}" for name in names]
        self._start("munged", "--foreground", "--force", f"--key-file={key}", f"--socket={socket}", *own)
        self._until(socket.exists, "munged listens")
        self._start("slurmctld", "-D", "-c", "-f", str(self._configuration))
        self.start_node()
        return self

    def __exit__(self, *_: object) -> None:
        self.run("scancel", "--me", check=False)
        self.lose_node()
        for process in self._processes.values():
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE_S)
            process.kill()
            process.wait()

    def _start(self, *command: str) -> None:
        with (self._folder / f"{command[0]}.out").open("ab") as output:
            self._processes[command[0]] = subprocess.Popen(
                command, env=self.variables, stdout=output, stderr=output, start_new_session=True
            )

    def run(self, *command: str, check: bool = True) -> str:
        """What one of Slurm's commands prints."""
        found = subprocess.run(
            command, env=self.variables, capture_output=True, text=True, check=check, timeout=PATIENCE_S
        )
        return found.stdout

    def start_node(self) -> None:
        """The node's daemon, until jobs may run there."""
        self._start("slurmd", "-D", "-f", str(self._configuration), "-N", NODE)
        self._until(lambda: self.node_state() in {"IDLE", "MIXED", "ALLOCATED"}, "the node is up")

    def kill_node_daemon(self) -> None:
        """slurmd alone: what it started goes on."""
        self._processes["slurmd"].kill()
        self._processes["slurmd"].wait()

    def lose_node(self) -> int:
        """All at once, as when its power fails: the daemon, the steps and what runs in them; how many processes."""
        self.kill_node_daemon()
        lost = [process for process in psutil.process_iter() if self._runs_in_a_job(process)]
        with contextlib.suppress(psutil.Error):
            lost += [step for process in lost for step in process.parents() if step.name() == "slurmstepd"]
        for process in lost:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(signal.SIGKILL)
        return len(set(lost))

    def _runs_in_a_job(self, process: psutil.Process) -> bool:
        with contextlib.suppress(psutil.Error):
            variables = process.environ()
            return variables.get("SLURM_CONF") == str(self._configuration) and "SLURM_JOB_ID" in variables
        return False

    def node_state(self) -> str:
        """Without the marks that Slurm adds; `NONE` while the controller does not answer."""
        said = self.run("scontrol", "show", "node", NODE, "--oneliner", check=False)
        found = re.search(r" State=([A-Z]+)", said)
        return found[1] if found else "NONE"

    def until_node_is_down(self) -> None:
        """The controller has noticed that the node is silent."""
        self._until(lambda: self.node_state() == "DOWN", "the node counts as down")

    def until_gone(self, job: str) -> None:
        """The job has ended."""
        self._until(lambda: job not in dict(self.jobs()), f"job {job} has ended")

    def jobs(self) -> list[tuple[str, str]]:
        """Id and state of each job that is not over."""
        said = self.run("squeue", "--noheader", "--array", "--format=%i %T")
        return [(line.split()[0], line.split()[1]) for line in said.splitlines()]

    def states(self) -> Counter[str]:
        """How many jobs are in each of Slurm's states."""
        return Counter(state for _, state in self.jobs())

    def _until(self, holds: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < end, f"waited too long until {what}: {self._said()}"
            time.sleep(0.2)

    def _said(self) -> str:
        logs = sorted([*self._folder.glob("*.out"), *self._folder.glob("*.log")])
        return "\n".join(f"{log.name}: {log.read_text(errors='replace')[-1500:]}" for log in logs)

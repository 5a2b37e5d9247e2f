"""Runs cells one after the other, each in its own process, and keeps their results."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from biresnerf.data.model.atomic_file import write_text
from biresnerf.errors import Interrupted
from biresnerf.studies.cell import CELL, EXIT_STOPPED, LOG, RESULT, RUN, Cell, CellResult

LAST_LINES = 12  # of a failed process's output
STOPPING_S = 60.0  # for a process to write its checkpoint


def finished(cells: Path, cell: Cell) -> CellResult | None:
    """The result of an earlier run of the comparison, outcome or failure; None if there is none."""
    path = cells / cell.folder_name / RESULT
    return CellResult.model_validate_json(path.read_text("utf-8")) if path.is_file() else None


def run_in_child(cells: Path, cell: Cell) -> CellResult:
    """Run a cell in its own process; resumes an interrupted one.

    A process that fails in any way leaves a result with the error.

    Raises:
        Interrupted: the cell was stopped from outside; it keeps its checkpoint.
    """
    folder = cells / cell.folder_name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULT).unlink(missing_ok=True)
    write_text(folder / CELL, cell.model_dump_json(indent=1))
    with (folder / LOG).open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "biresnerf.studies.run_cell", str(folder)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            status = process.wait()
        except BaseException:
            _stop(process)
            raise
    result = finished(cells, cell)
    if result is not None and status == 0:
        return result
    if status == EXIT_STOPPED:
        raise Interrupted(f"{folder.name} was stopped; run again to resume")
    last_lines = (folder / LOG).read_text("utf-8", errors="replace").strip().splitlines()[-LAST_LINES:]
    reason = f"killed by signal {-status}" if status < 0 else f"exit status {status}"
    failure = CellResult(cell=cell, error="\n".join([reason, *last_lines]))
    shutil.rmtree(folder / RUN, ignore_errors=True)
    write_text(folder / RESULT, failure.model_dump_json(indent=1))
    return failure


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOPPING_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()

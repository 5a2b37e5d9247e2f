"""The folder a refinement writes to: which folders it may use, and what it removes at the end."""

from __future__ import annotations

import logging
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from biresnerf.data.model.refined_set import BODY, REFINED
from biresnerf.data.photos.panoramas.cut_panoramas import PANORAMA_VIEWS
from biresnerf.data.seeding.colmap_process import LOG
from biresnerf.data.show.history import HISTORY
from biresnerf.data.show.view_file import CONTACT_SHEET, PREVIEW, THUMBNAIL, VIEW
from biresnerf.errors import InputError
from biresnerf.options.formats import formats
from biresnerf.stages import CHECKPOINT, OTHER_FOLDER
from biresnerf.viewer.report_html import REPORT_HTML

logger = logging.getLogger(__name__)

REPORT, CONFIG, GEOREFERENCE = "report.json", "config.json", "georeference.json"
RENDERS, ORBIT = "renders", "renders/orbit.mp4"


class OutputFolder:
    """The folder of one run. Refuses folders that hold something else.

    Args:
        keep_reusable: leave behind what other runs of the set can start from.
        title: heading of report.html.
    """

    def __init__(self, path: Path, *, keep_reusable: bool = False, title: str | None = None) -> None:
        self.path, self.title, self._keep_reusable = Path(path), title, keep_reusable

    @property
    def preview(self) -> Path:
        return self.path / PREVIEW

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other runs out of the folder; afterwards remove it if it was new and is empty.

        Raises:
            InputError: ``output_in_use``.
        """
        self._refuse_file()
        new = not self.path.exists()
        self.path.mkdir(parents=True, exist_ok=True)
        folder = os.open(self.path, os.O_RDONLY) if sys.platform != "win32" else None
        try:
            if folder is not None:
                self._lock(folder)
            yield
        finally:
            if folder is not None:
                os.close(folder)  # a killed process leaves no lock behind, either
            if new:
                with suppress(OSError):
                    self.path.rmdir()

    def _lock(self, folder: int) -> None:
        import fcntl

        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            hint = "Wait until it ends, stop it, or name another folder."
            where = str(self.path)
            raise InputError(
                "output_in_use", "is where another run writes.", where=where, hint=hint
            ) from error
        except OSError as error:
            logger.info("%s is on a file system without locks: %s", self.path, error)

    def _refuse_file(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise InputError("output_not_a_folder", "is a file.", where=str(self.path), hint="Name a folder.")

    def refuse_finished(self) -> None:
        """Raise `InputError` unless the folder is new, empty, or holds an unfinished run."""
        self._refuse_file()
        if not self.path.is_dir() or (self.path / CHECKPOINT).is_file():
            return
        before_training = {CHECKPOINT.parent.name, HISTORY, PREVIEW, PANORAMA_VIEWS}
        if not {path.name for path in self.path.iterdir()} - before_training:
            return  # new, or killed before the first checkpoint
        where = str(self.path)
        if (self.path / REPORT).is_file():
            hint = f"Look at {self.path / REPORT_HTML}; --overwrite replaces it."
            raise InputError("output_finished", "holds a finished result.", where=where, hint=hint)
        detail = "is not empty, and nothing in it can be resumed."
        raise InputError("output_not_empty", detail, where=where, hint=OTHER_FOLDER)

    def remove_result(self) -> None:
        """Remove the files of a finished result, and nothing else."""
        if not (self.path / REPORT).is_file():
            return
        written = {one.in_result for one in formats().values()}
        written |= {
            REPORT,
            REPORT_HTML,
            CONFIG,
            HISTORY,
            GEOREFERENCE,
            LOG,
            CHECKPOINT.parent.name,
            PANORAMA_VIEWS,
        }
        written |= {RENDERS, REFINED, BODY, THUMBNAIL, VIEW, CONTACT_SHEET}
        for name in {Path(file).parts[0] for file in written if file}:
            path = self.path / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def remove_preview(self) -> None:
        """Remove previews."""
        shutil.rmtree(self.preview, ignore_errors=True)

    def remove_refined(self) -> None:
        """Remove refined poses beside those of the result."""
        shutil.rmtree(self.path / REFINED, ignore_errors=True)

    def clean_up(self, *, failed: bool = False) -> None:
        """Remove what only an unfinished run needs, and what others could start from unless that is to be kept.

        COLMAP's log is kept if something ``failed``.
        """
        if failed and (said := self.path / CHECKPOINT.with_name(LOG)).is_file():
            said.replace(self.path / LOG)
        shutil.rmtree(self.preview, ignore_errors=True)
        if self._keep_reusable:
            (self.path / CHECKPOINT).unlink(missing_ok=True)
        else:
            shutil.rmtree(self.path / CHECKPOINT.parent, ignore_errors=True)

"""Files that other libraries decode, as images that Pillow opens: the size at once, the pixels on request."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFile

from biresnerf.errors import InputError


class PictureFile(ImageFile.ImageFile):
    """A Pillow image whose subclass measures the file when it is opened, and decodes it when it is loaded.

    Errors of other libraries are raised as those of Pillow for damaged files: SyntaxError on opening, which lets
    the next format have its try, and OSError on loading.
    """

    @property
    def path(self) -> Path:
        """The file."""
        return Path(os.fsdecode(self.filename))

    def measure(self) -> tuple[int, int, str]:
        """Width, height and Pillow's mode, from the file's head."""
        raise NotImplementedError

    def pixels(self) -> NDArray[np.uint8]:
        """uint8 [h, w] or [h, w, channels], as `measure` said."""
        raise NotImplementedError

    def _open(self) -> None:
        if not self.filename:
            raise SyntaxError("no file of its own")
        try:
            width, height, self._mode = self.measure()
        except Exception as error:  # noqa: BLE001 - each library has its own
            raise SyntaxError(str(error)) from None
        self._size = (width, height)

    def load(self) -> Any:
        """Decodes the file, once."""
        if self._im is None:
            try:
                found = self.pixels()
            except (InputError, MemoryError):
                raise
            except Exception as error:  # noqa: BLE001 - each library has its own
                raise OSError(str(error)) from None
            if found.shape[:2] != (self.height, self.width):
                raise OSError(f"{found.shape[1]} x {found.shape[0]} px, not {self.width} x {self.height}")
            self.im = Image.fromarray(np.ascontiguousarray(found), self.mode).im
        return super().load()

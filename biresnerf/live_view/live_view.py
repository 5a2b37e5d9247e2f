"""The view itself: a viser server whose cameras follow an output folder."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rich
from numpy.typing import NDArray

from biresnerf.errors import InputError
from biresnerf.geometry.rigid import quat_wxyz_from_rotation
from biresnerf.live_view.state import (
    Picture,
    Seen,
    newest_poses,
    photos_of,
    photos_of_result,
    read_state,
)

try:
    import psutil
    import viser
except ModuleNotFoundError:
    raise InputError(
        "extra_missing",
        "needs viser, which is not installed.",
        where="the live view",
        hint="Install it with: pip install 'biresnerf[view]'",
    ) from None

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 0.5
FRUSTUM = 0.12  # height of a drawn camera, of the cameras' spread
AFTER, BEFORE = (31, 119, 180), (150, 150, 150)
FAR = 2.5  # of the first look from the middle, in spreads of the cameras


class LiveView:
    """Shows the cameras of ``folder`` at `url`, with their photos, and moves them as its files change.

    Args:
        photos: the input, for photos while the run is in progress; a result holds small ones.
        host, port: to listen on; another port where this one is taken.

    Raises:
        InputError: ``extra_missing`` without viser.
    """

    def __init__(
        self, folder: Path, photos: Path | None = None, *, host: str = "127.0.0.1", port: int = 8080
    ) -> None:
        self._folder, self._source = folder, photos
        self._photos: dict[str, Picture] | None = None
        self._drawn: tuple[Path, int] | None = None
        self._names: tuple[str, ...] = ()
        self._cameras: dict[str, Any] = {}
        self._first_look = (np.full(3, 3.0), np.zeros(3))
        # A browser that connects, in another thread, while cameras are drawn must not keep the old view.
        self._looking = threading.Lock()
        self.server = _listening(host, port)
        self.url = f"http://{host}:{self.server.get_port()}"
        self._said = self.server.gui.add_markdown("nothing to see yet")
        for name, label in (("after", "refined poses"), ("before", "given poses")):
            self._add_switch(name, label)
        self.server.on_client_connect(self._look_at_all)

    def update(self) -> bool:
        """Draw what is new in the folder; returns whether anything was."""
        try:
            poses = newest_poses(self._folder)
            now = None if poses is None else (poses, poses.stat().st_mtime_ns)
            if poses is None or now == self._drawn:
                return False
            seen = read_state(self._folder, poses)
        except (InputError, OSError) as error:  # the run is just replacing its files: the next update will do
            logger.debug("not drawn: %s", error)
            return False
        self._draw(seen)
        self._drawn = now
        return True

    def follow(self, stop: threading.Event) -> None:
        """Update until ``stop`` is set."""
        self.update()
        while not stop.wait(LOOK_EVERY_S):
            self.update()

    def stop(self) -> None:
        """Close the server."""
        self.server.stop()

    def _add_switch(self, name: str, label: str) -> None:
        parent = self.server.scene.add_frame(f"/{name}", show_axes=False)
        switch = self.server.gui.add_checkbox(label, initial_value=True)

        @switch.on_update
        def _(_event: Any) -> None:
            parent.visible = switch.value

    def _draw(self, seen: Seen) -> None:
        new = seen.names != self._names
        if new:
            for handle in self._cameras.values():
                handle.remove()
            self._cameras, self._names = {}, seen.names
            self._photos = None
        photos = self._photos_for(seen)
        size = FRUSTUM * _spread(seen)
        for kind, poses, colour in (("after", seen.after, AFTER), ("before", seen.before, BEFORE)):
            for i, pose in enumerate(poses):
                if np.isfinite(pose).all():
                    picture = photos.get(seen.names[i]) if kind == "after" else None
                    self._place(f"/{kind}/{i}", pose, seen, i, size, colour, picture)
        if len(seen.points):
            self.server.scene.add_point_cloud(
                "/points", seen.points.astype(np.float32), seen.colours, point_size=0.01 * _spread(seen)
            )
        self._said.content = f"{len(seen.names)} photos: {seen.said}"
        with self._looking:
            self._first_look = _first_look(seen)
        self.server.scene.set_up_direction(tuple(_up(seen).tolist()))
        for client in self.server.get_clients().values() if new else ():
            self._look_at_all(client)

    def _place(
        self, path: str, pose: NDArray[np.float64], seen: Seen, index: int, size: float,
        colour: tuple[int, int, int], picture: Picture | None,
    ) -> None:  # fmt: skip
        """Move the camera at ``path``, or make it: viser's cameras have our axes."""
        turned, centre = quat_wxyz_from_rotation(pose[:3, :3]), pose[:3, 3]
        known = self._cameras.get(path)
        if known is not None:
            known.wxyz, known.position = turned, centre
            return
        camera = seen.cameras[index]
        added = self.server.scene.add_camera_frustum(
            path,
            fov=2 * math.atan2(camera.height / 2, camera.full().fy),
            aspect=camera.width / camera.height,
            scale=size,
            line_width=1.0,
            color=colour,
            image=picture,
            wxyz=turned,
            position=centre,
        )
        self._cameras[path] = added

        @added.on_click
        def _(event: Any) -> None:
            client = event.client
            with client.atomic():
                client.camera.wxyz, client.camera.position = added.wxyz, added.position

    def _photos_for(self, seen: Seen) -> dict[str, Picture]:
        if self._photos is None:
            try:
                self._photos = (
                    photos_of_result(self._folder, seen) if self._source is None else photos_of(self._source)
                )
            except InputError as error:
                logger.warning("the view has no photos: %s", error)
                self._photos = {}
        return self._photos

    def _look_at_all(self, client: Any) -> None:
        with self._looking:
            client.camera.position, client.camera.look_at = self._first_look


def _listening(host: str, port: int) -> Any:
    rich.reconfigure(quiet=True)  # viser prints boxes about itself with it, where commands print JSON
    while True:
        try:
            return viser.ViserServer(host, port, label="BiResNeRF", verbose=False)
        except psutil.NoSuchProcess:  # viser 0.2 looks at all processes, and fails where one has just ended
            continue


def _spread(seen: Seen) -> float:
    """How far the cameras are from their middle, and 1 where they are at one place."""
    return float(np.linalg.norm(seen.after[:, :3, 3].std(0))) or 1.0


def _up(seen: Seen) -> NDArray[np.float64]:
    """The up direction: against the mean of the pictures' downward axes; z where these cancel out."""
    up = -seen.after[:, :3, 1].mean(0)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.1 else np.array([0.0, 0.0, 1.0])


def _first_look(seen: Seen) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The first viewpoint, behind and above the first camera, and its target, the middle of everything."""
    centres = seen.after[:, :3, 3]
    middle = np.median(seen.points, axis=0) if len(seen.points) else centres.mean(0)
    away = centres[0] - middle + _up(seen) * _spread(seen)
    length = float(np.linalg.norm(away)) or 1.0
    return middle + away * (FAR * _spread(seen) / length), middle


@contextmanager
def shown_live(view: LiveView) -> Iterator[LiveView]:
    """Follow the folder in a thread while the block runs."""
    stop = threading.Event()
    thread = threading.Thread(target=view.follow, args=(stop,), name="live view", daemon=True)
    thread.start()
    try:
        yield view
    finally:
        stop.set()
        thread.join()
        view.stop()

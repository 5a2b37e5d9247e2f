"""A client of the live view: what a browser is sent over the websocket, gathered into a scene."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import msgspec
import numpy as np
from websockets.sync.client import connect


class Browser:
    """Connects to the view and keeps what it is told.

    Attributes:
        scene: properties of each thing in the scene by its path, with `wxyz`, `position` and `visible`.
        texts: what the panel says.
        switches: the panel's switches: their ids by label.
        camera: where the view put this client's own camera: `Position`, `LookAt`, `UpDirection`.
    """

    def __init__(self, url: str) -> None:
        self._open = ExitStack()
        self._socket = self._open.enter_context(connect(url.replace("http", "ws", 1), max_size=None))
        self.scene: dict[str, dict[str, Any]] = {}
        self.texts: list[str] = []
        self.switches: dict[str, str] = {}
        self.camera: dict[str, Any] = {}
        # As a page does once it is there; until then viser counts nobody.
        self._send(
            "ViewerCameraMessage",
            wxyz=(1.0, 0.0, 0.0, 0.0), position=(9.0, 9.0, 9.0), fov=1.0, near=0.1, far=100.0, aspect=1.0,
            look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 0.0, 1.0),
        )  # fmt: skip

    def until(self, seen: Callable[[], Any], seconds: float = 60.0) -> None:
        """Listens until ``seen`` holds. Raises AssertionError where it does not come to that."""
        end = time.monotonic() + seconds
        while not seen():
            assert time.monotonic() < end, (sorted(self.scene), self.texts)
            try:
                received = self._socket.recv(timeout=0.2)
            except TimeoutError:
                continue
            assert isinstance(received, bytes)
            for message in msgspec.msgpack.decode(received):
                self._take(message)

    def switch(self, label: str, value: bool) -> None:
        """Ticks or unticks a switch of the panel, as a click does."""
        self._send("GuiUpdateMessage", uuid=self.switches[label], updates={"value": value})

    def click(self, path: str) -> None:
        """Clicks on a thing of the scene."""
        self._send(
            "SceneNodeClickMessage",
            name=path, instance_index=None, ray_origin=(0.0, 0.0, 0.0), ray_direction=(0.0, 0.0, 1.0),
            screen_pos=(0.5, 0.5),
        )  # fmt: skip

    def close(self) -> None:
        """Leaves."""
        self._open.close()

    def _send(self, kind: str, **content: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **content}))

    def _take(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind in ("CameraFrustumMessage", "PointCloudMessage", "FrameMessage"):
            self.scene.setdefault(message["name"], {}).update(message["props"], kind=kind)
        elif kind in ("SetOrientationMessage", "SetPositionMessage", "SetSceneNodeVisibilityMessage"):
            known = self.scene.setdefault(message["name"], {})
            known.update({key: message[key] for key in ("wxyz", "position", "visible") if key in message})
        elif kind.startswith("SetCamera"):
            values = [value for key, value in message.items() if key != "type"]
            self.camera[kind.removeprefix("SetCamera").removesuffix("Message")] = np.array(values[0])
        elif kind == "RemoveSceneNodeMessage":
            self.scene.pop(message["name"], None)
        elif kind == "GuiMarkdownMessage":
            self.texts.append(message["props"]["_markdown"])
        elif kind == "GuiCheckboxMessage":
            self.switches[message["props"]["label"]] = message["uuid"]
        elif kind == "GuiUpdateMessage":
            self.texts += [text for key, text in message["updates"].items() if key == "_markdown"]

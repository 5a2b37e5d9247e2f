"""Binary glTF 2.0 of points, lines and triangles: what a picture of a scene needs, and no more of the format.

Layout: Khronos glTF 2.0 specification, sections 3.6 (buffers and accessors) and 4.4 (GLB); little-endian.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

POINTS, LINES, TRIANGLES = 0, 1, 4  # primitive modes
_UNSIGNED_BYTE, _UNSIGNED_INT, _FLOAT = 5121, 5125, 5126
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_CLEAR = 0.2  # opacity of triangles, so that what lies behind is seen
_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942


@dataclass
class GlbFile:
    """Gathers meshes of points or lines; `content` gives the bytes of the file.

    Attributes:
        extras: what the file says of itself, under ``asset.extras``.
    """

    extras: dict[str, Any] = field(default_factory=dict)
    _binary: bytearray = field(default_factory=bytearray)
    _views: list[dict[str, Any]] = field(default_factory=list)
    _accessors: list[dict[str, Any]] = field(default_factory=list)
    _meshes: list[dict[str, Any]] = field(default_factory=list)
    _nodes: list[dict[str, Any]] = field(default_factory=list)

    def add_mesh(
        self,
        name: str,
        mode: int,
        xyz: NDArray[np.floating],
        rgb: NDArray[np.uint8],
        indices: NDArray[np.integer] | None = None,
        triangles: NDArray[np.integer] | None = None,
    ) -> None:
        """A mesh with a node of its own.

        Args:
            name: of both.
            mode: `POINTS` or `LINES`.
            xyz: [vertices, 3], finite and not none; kept as float32.
            rgb: uint8 [vertices, 3], sRGB.
            indices: of the vertices, for lines two a line.
            triangles: faces between the same vertices, indices [m, 3], drawn faintly from both sides.
        """
        positions = np.ascontiguousarray(xyz, dtype="<f4")
        # Four bytes each: rows must start at multiples of 4.
        colours = np.full((len(rgb), 4), 255, dtype=np.uint8)
        colours[:, :3] = _linear(rgb)
        bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
        primitive: dict[str, Any] = {
            "mode": mode,
            "material": 0,
            "attributes": {
                "POSITION": self._accessor(positions, _FLOAT, "VEC3", _ARRAY_BUFFER, **bounds),
                "COLOR_0": self._accessor(colours, _UNSIGNED_BYTE, "VEC4", _ARRAY_BUFFER, normalized=True),
            },
        }
        primitives = [primitive]
        if indices is not None:
            primitive["indices"] = self._indices(indices)
        if triangles is not None:
            primitives.append(
                {**primitive, "mode": TRIANGLES, "material": 1, "indices": self._indices(triangles)}
            )
        self._nodes.append({"name": name, "mesh": len(self._meshes)})
        self._meshes.append({"name": name, "primitives": primitives})

    def content(self, root: dict[str, Any]) -> bytes:
        """The file. ``root`` is the node above all meshes: its name, translation and rotation."""
        nodes = [*self._nodes, {**root, "children": list(range(len(self._nodes)))}]
        document = {
            "asset": {"version": "2.0", "generator": "BiResNeRF", "extras": self.extras},
            # Colours as they are, not shaded: this is a drawing.
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"nodes": [len(nodes) - 1]}],
            "nodes": nodes,
            "meshes": self._meshes,
            "materials": [
                _material("unlit", 1.0),
                _material("faint", _CLEAR, alphaMode="BLEND", doubleSided=True),
            ],
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._binary)}],
        }
        text = json.dumps(document, ensure_ascii=False, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self._binary) + b"\0" * (-len(self._binary) % 4)
        size = 12 + 8 + len(text) + 8 + len(binary)
        return b"".join(
            [
                struct.pack("<3I", _MAGIC, _VERSION, size),
                struct.pack("<2I", len(text), _JSON_CHUNK) + text,
                struct.pack("<2I", len(binary), _BINARY_CHUNK) + binary,
            ]
        )

    def _indices(self, of_vertices: NDArray[np.integer]) -> int:
        flat = np.ascontiguousarray(of_vertices, dtype="<u4").ravel()
        return self._accessor(flat, _UNSIGNED_INT, "SCALAR", _ELEMENT_BUFFER)

    def _accessor(
        self, values: NDArray[np.generic], component: int, kind: str, target: int, **more: Any
    ) -> int:
        self._binary += b"\0" * (-len(self._binary) % 4)
        data = values.tobytes()
        self._views.append(
            {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data), "target": target}
        )
        self._binary += data
        self._accessors.append(
            {
                "bufferView": len(self._views) - 1,
                "componentType": component,
                "type": kind,
                "count": len(values),
                **more,
            }
        )
        return len(self._accessors) - 1


def _material(name: str, opacity: float, **more: Any) -> dict[str, Any]:
    shown = {"baseColorFactor": [1.0, 1.0, 1.0, opacity], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {
        "name": name,
        "pbrMetallicRoughness": shown,
        "extensions": {"KHR_materials_unlit": {}},
        **more,
    }


def _linear(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """glTF's vertex colours are linear light (section 3.9.2); ours are sRGB."""
    share = rgb.astype(np.float64) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * linear).astype(np.uint8)

"""Metashape's camera export (XML): sensors, cameras, and their poses in the chunk's own frame.

Lens: Agisoft Metashape user manual, appendix on camera models ("frame" type). Its p1 and p2 are COLMAP's p2 and p1. b2
is skew, which is taken out of the photos. The cameras of a rig have their master's pose, moved by the rotation and
location of their sensor, which lead from its frame to the master's: metashape_to_krt.py, a converter of Meta's.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import attempt
from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import (
    camera_of_numbers,
    image_name,
    supported_model,
    unsupported,
)
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, parsed_rows, pose_by, shear_of, without_skew
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_xml
from biresnerf.data.photos.panoramas.panorama import panorama_camera
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format

METASHAPE = Format(
    name="metashape",
    title="Metashape",
    rank=70,
    found_as=("*.xml",),
    suffixes=(".xml",),
    gives="a camera export, cameras of type frame",
    checked_against="its manual; KU-Leuven-Geomatics/geomapi, bitbyt3r/metashape-automation (skew)",
)


_HINT = "Export the cameras from Metashape again."


def parse_metashape(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of a Metashape export, in the order of their labels.

    Labels are file names, with or without extension. The world is the chunk's own frame: the chunk's transform into
    geographic coordinates is not applied. Cameras that are not aligned, or belong to another component than most, have
    no pose.
    """
    chunk = the_chunk(file)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    cameras = cameras_by_label(chunk, file)
    components = Counter(
        camera.get("component_id") for camera in cameras.values() if camera.find("transform") is not None
    )
    main = components.most_common(1)[0][0] if components else None
    by_id = {camera.get("id"): camera for camera in cameras.values()}

    @cache
    def lens_of(sensor: str | None) -> Camera | InputError | None:
        return attempt(partial(_camera, sensors.get(sensor), f"{file.name} sensor {sensor}"))

    def read(camera: ElementTree.Element, where: str) -> Placed:
        master, sensor = by_id.get(camera.get("master_id")), camera.get("sensor_id")
        rig = None if master is None else (master, sensors.get(sensor))
        return _read(camera, rig, lens_of(sensor), where)

    rows = [(label, f"{file.name} camera {label!r}", camera) for label, camera in sorted(cameras.items())]
    parsed = parsed_rows(METASHAPE, [file], rows, read, take_file_names=True)
    placed = {label: by_id.get(camera.get("master_id"), camera) for label, camera in cameras.items()}
    entries = tuple(
        entry if placed[entry.name].get("component_id") == main else replace(entry, world_from_cam=None)
        for entry in parsed.entries
    )
    apart = [
        new.name
        for old, new in zip(parsed.entries, entries, strict=True)
        if old.world_from_cam is not new.world_from_cam
    ]
    notes = [f"{file.name}: poses are in the chunk's own frame; its transform was not applied"]
    if apart:
        notes.append(
            f"{len(apart)} images belong to another component; their poses were not taken: {few_names(apart)}"
        )
    return replace(parsed, entries=entries, notes=tuple(notes))


def the_chunk(file: Path) -> ElementTree.Element:
    """The one chunk of the file."""
    tree = read_xml(file, _HINT)
    chunks = [tree] if tree.tag == "chunk" else list(tree.iter("chunk"))
    if len(chunks) != 1:
        raise invalid_file(file.name, f"has {len(chunks)} chunks, not one.", _HINT)
    return chunks[0]


def cameras_by_label(chunk: ElementTree.Element, file: Path) -> dict[str, ElementTree.Element]:
    """The cameras by label, except those switched off."""
    entries: dict[str, ElementTree.Element] = {}
    for entry in chunk.iter("camera"):
        label = image_name(entry.get("label") or "", f"{file.name} camera {entry.get('id')}")
        if entry.get("enabled") in ("0", "false"):
            continue
        if label in entries:
            raise InputError(
                "duplicate_image",
                "two cameras have this label.",
                where=f"{file.name} camera {label!r}",
                hint="Remove one.",
            )
        entries[label] = entry
    return entries


_Rig: TypeAlias = tuple[ElementTree.Element, ElementTree.Element | None] | None


def _read(camera: ElementTree.Element, rig: _Rig, lens: Camera | InputError | None, where: str) -> Placed:
    """Pose and lens of a camera; ``rig``: its master and its own sensor."""
    if isinstance(lens, InputError):
        raise lens
    pose = _pose(camera, where)
    if pose is None and rig is not None:
        world_from_master, sensor = _pose(rig[0], where), rig[1]
        if world_from_master is not None and sensor is not None:
            pose = world_from_master @ _master_from_sensor(sensor, where)
    return pose, lens


def _master_from_sensor(sensor: ElementTree.Element, where: str) -> NDArray[np.float64]:
    words = (sensor.findtext("rotation") or "1 0 0 0 1 0 0 0 1").split()
    rotation = finite_numbers(words, f"{where} sensor rotation", _HINT, 9).reshape(3, 3)
    words = (sensor.findtext("location") or "0 0 0").split()
    location = finite_numbers(words, f"{where} sensor location", _HINT, 3)
    return pose_by(METASHAPE, np.column_stack([rotation, location]), where)


def _pose(entry: ElementTree.Element, where: str) -> NDArray[np.float64] | None:
    transform = entry.find("transform")
    if transform is None:
        return None
    values = finite_numbers((transform.text or "").split(), f"{where} transform", _HINT, 16)
    return pose_by(METASHAPE, values.reshape(4, 4), where)


def _camera(sensor: ElementTree.Element | None, where: str) -> Camera | None:
    """The adjusted calibration (else the first) as a COLMAP camera; None where the file has none."""
    if sensor is None:
        return None
    found = sensor.findall("calibration")
    adjusted = [one for one in found if one.get("class") == "adjusted"]
    calibration = next(iter(adjusted or found), None)
    kind = (None if calibration is None else calibration.get("type")) or sensor.get("type") or "frame"
    if kind == "spherical":
        return panorama_camera(*_resolution(sensor, calibration, where), where)
    if kind != "frame":
        raise unsupported(
            where,
            f"the camera type {kind[:40]} is not supported.",
            "Export undistorted images and cameras of the type frame.",
        )
    if calibration is None:
        return None
    values = {}
    for name in ("f", "fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2"):
        numbers = finite_numbers(calibration.findtext(name, "").split(), where, _HINT)
        values[name] = float(numbers[0]) if len(numbers) else 0.0
    unmodelled = [name for name in ("k4", "p3", "p4") if values[name]]
    if unmodelled:
        raise unsupported(
            where,
            f"{', '.join(unmodelled)} is not zero, and no supported camera model has it.",
            "Optimise the cameras without it and export again, or export undistorted images.",
        )
    width, height = _resolution(sensor, calibration, where)
    shear = shear_of(values["b2"], values["f"] or values["fy"], where)
    return without_skew(_colmap_camera(values, width, height, where), shear, where)


def _resolution(
    sensor: ElementTree.Element, calibration: ElementTree.Element | None, where: str
) -> tuple[int, int]:
    resolution = None if calibration is None else calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    size = {} if resolution is None else resolution.attrib
    try:
        return int(size["width"]), int(size["height"])
    except (KeyError, ValueError):
        raise invalid_file(where, "has no resolution of whole width and height.", _HINT) from None


def _colmap_camera(values: dict[str, float], width: int, height: int, where: str) -> Camera:
    focal_y = values["f"] or values["fy"]
    focal_x = values["f"] + values["b1"] if values["f"] else values["fx"]
    # Newer exports measure the principal point from the image's centre, older ones (fx, fy) from its corner.
    from_centre = bool(values["f"])
    cx = values["cx"] + width / 2 if from_centre else values["cx"]
    cy = values["cy"] + height / 2 if from_centre else values["cy"]
    pinhole = (focal_x, focal_y, cx, cy)
    lens = (values["k1"], values["k2"], values["p2"], values["p1"])
    params: tuple[float, ...]
    if values["k3"]:
        model, params = "FULL_OPENCV", (*pinhole, *lens, values["k3"], 0.0, 0.0, 0.0)
    elif any(lens):
        model, params = "OPENCV", (*pinhole, *lens)
    else:
        model, params = "PINHOLE", pinhole
    return camera_of_numbers(supported_model(model, where), width, height, params, where)


CODECS = (Codec(METASHAPE, parse=parse_metashape, recognises=head_holds(b"<chunk")),)

"""Measured positions of any source tie a result to the Earth, and the user's own frame stays what it was."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from biresnerf.client.scene import look_at
from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from biresnerf.geometry.earth.geodesy import place_of
from biresnerf.geometry.similarity import Similarity
from biresnerf.write.georeference import GEOREFERENCE, write_georeference
from tests.data.photos.geotagged import geotag, write_geotagged
from tests.data.scenes import nerfstudio_scene, save, write_image

COUNT = 12
ORIGIN = np.array([-33.86, 151.21, 20.0])
WORLD_FROM_METRES = Similarity(0.1, Rotation.from_rotvec([1.0, 0.2, 0.4]).as_matrix(), np.array([3.0, 2, 1]))
CENTRES_M = np.random.default_rng(4).uniform(-40, 40, (COUNT, 3))


def world() -> np.ndarray:
    """The cameras [n, 4, 4] in the user's own frame."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, 3] = CENTRES_M
    return WORLD_FROM_METRES.apply_to_poses(poses)


def photos(folder: Path) -> Dataset:
    save(folder, nerfstudio_scene(folder, COUNT))
    return read_dataset(folder)


def metres(matrix: list[list[float]]) -> np.ndarray:
    """Where the report's transform puts the cameras."""
    return world()[:, :3, 3] @ np.array(matrix)[:3, :3].T + np.array(matrix)[:3, 3]


def test_a_csv_of_degrees_gives_east_north_up_with_its_origin_and_a_place_for_each_camera(tmp_path):
    places = place_of(CENTRES_M, ORIGIN)
    rows = [f"{i:03}.jpg,{a:.9f},{b:.9f},{c:.4f},0.05" for i, (a, b, c) in enumerate(places)]
    (tmp_path / "gps.csv").write_text("\n".join(["name,lat,lon,alt,accuracy", *rows]))
    dataset = photos(tmp_path)
    assert any("gps.csv" in note and f"{COUNT} of {COUNT}" in note for note in dataset.warnings)
    found = write_georeference(dataset, world(), tmp_path)
    assert (found.source, found.images, found.used, found.epsg) == ("gps.csv", COUNT, COUNT, 4979)
    assert found.accuracy_m == 0.05
    assert found.residual_m < 1e-3
    assert set(found.residuals_m) == set(dataset.names)
    origin = np.array([found.latitude, found.longitude, found.altitude])
    # Seen from the report's own origin, the cameras are where they were.
    np.testing.assert_allclose(
        place_of(metres(found.metres_from_world), origin)[:, :2], places[:, :2], atol=2e-8
    )
    written = json.loads((tmp_path / GEOREFERENCE).read_text())
    for camera, place in zip(written["cameras"], places, strict=True):
        np.testing.assert_allclose([camera["latitude"], camera["longitude"]], place[:2], atol=2e-8)
        assert camera["altitude"] == pytest.approx(place[2], abs=2e-3)


def test_a_csv_of_metres_keeps_its_own_frame(tmp_path):
    rows = [f"{i:03},{x},{y},{z}" for i, (x, y, z) in enumerate(CENTRES_M + 1000)]
    (tmp_path / "positions.csv").write_text("\n".join(["name,x,y,z", *rows]))
    found = write_georeference(photos(tmp_path), world(), tmp_path)
    np.testing.assert_allclose(metres(found.metres_from_world), CENTRES_M + 1000, atol=1e-6)
    assert (found.latitude, found.epsg) == (None, None)


def test_exif_is_used_with_the_error_that_it_states(tmp_path):
    dataset = photos(tmp_path)
    for i, (frame, place) in enumerate(zip(dataset.frames, place_of(CENTRES_M, ORIGIN), strict=True)):
        write_geotagged(frame.path, tuple(place))
        if i < 3:
            continue
        tags = geotag(*place)
        tags[0x8825] = {**tags[0x8825], 0x1F: 4.0}
        Image.new("RGB", (20, 16)).save(frame.path, exif=tags)
    priors = position_priors(dataset)
    assert priors.source == "EXIF"
    assert np.isnan(priors.accuracy_m[:3]).all()
    assert (priors.accuracy_m[3:] == 4.0).all()
    found = write_georeference(dataset, world(), tmp_path)
    assert found.accuracy_m == 4.0
    assert found.residual_m < 0.05


def test_a_table_goes_before_exif(tmp_path):
    dataset = photos(tmp_path)
    for frame, place in zip(dataset.frames, place_of(CENTRES_M, ORIGIN), strict=True):
        write_geotagged(frame.path, tuple(place))
    (tmp_path / "gps.csv").write_text("name,x,y,z\n000.jpg,1,2,3\n")
    assert position_priors(dataset).source == "gps.csv"


def metashape_xml(system: str, places: np.ndarray, accuracy: str) -> str:
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" label="{i:03}.jpg">'
        f"<transform>{' '.join(map(str, pose.ravel()))}</transform>"
        f'<reference x="{x}" y="{y}" z="{z}" {accuracy if i else ""} enabled="true"/></camera>'
        for i, (pose, (x, y, z)) in enumerate(zip(world() / 1.0, places, strict=True))
    )
    return (
        '<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame"><resolution width="20" height="16"/>'
        '<calibration type="frame" class="adjusted"><resolution width="20" height="16"/><f>18</f></calibration>'
        f"</sensor></sensors><cameras>{cameras}</cameras><reference>{system}</reference>"
        '<settings><property name="accuracy_cameras" value="10"/></settings></chunk></document>'
    )


def test_metashapes_references_are_used_with_their_accuracy_and_its_poses_stay(tmp_path):
    for i in range(COUNT):
        write_image(tmp_path / f"{i:03}.jpg", i)
    places = place_of(CENTRES_M, ORIGIN)[:, [1, 0, 2]]
    xml = metashape_xml('GEOGCS["WGS 84",AUTHORITY["EPSG","4326"]]', places, 'sxyz="0.5"')
    (tmp_path / "cameras.xml").write_text(xml)
    dataset = read_dataset(tmp_path)
    assert dataset.source.dialect == "metashape"
    np.testing.assert_allclose(dataset.world_from_cam, world(), atol=1e-9)
    priors = position_priors(dataset)
    assert priors.accuracy_m[:, 0].tolist() == [10.0, *[0.5] * (COUNT - 1)]
    found = write_georeference(dataset, dataset.world_from_cam, tmp_path)
    assert (found.source, found.epsg) == ("cameras.xml", 4979)
    assert found.residual_m < 1e-2


def test_what_positions_do_not_tell_is_not_claimed_and_no_file_is_written(tmp_path):
    rows = [f"{i:03}.jpg,{x},0,0" for i, x in enumerate(range(COUNT))]
    (tmp_path / "gps.csv").write_text("\n".join(["name,x,y,z", *rows]))
    dataset, line = photos(tmp_path), world()
    line[:, :3, 3] = np.outer(np.arange(COUNT), [1.0, 2.0, 3.0])
    found = write_georeference(dataset, line, tmp_path)
    assert found.metres_from_world is None
    assert "line" in found.why_not
    assert not (tmp_path / GEOREFERENCE).exists()
    (tmp_path / "gps.csv").unlink()
    assert write_georeference(replace(dataset), line, tmp_path) is None


def test_a_bad_table_is_refused_when_the_set_is_read_and_a_good_one_is_sent_with_it(tmp_path):
    (tmp_path / "gps.csv").write_text("name,lat,lon,alt\n000.jpg,1,2,3\n")
    photos(tmp_path)
    assert "gps.csv" in [name for name, _ in look_at(tmp_path)]
    (tmp_path / "gps.csv").write_text("name,lat,lon,alt\n000.jpg,1000,2,3\n")
    with pytest.raises(InputError, match="latitude 1000"):
        read_dataset(tmp_path)

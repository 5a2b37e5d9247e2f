"""Tables of positions as people and programs write them are read with their accuracy, or refused with the line."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.formats.positions.position_table import is_geographic, position_files, read_position_table
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.photos.geotagged import geotag
from tests.data.scenes import assert_complete, nerfstudio_scene, save

DEGREES = "name,lat,lon,alt,accuracy\na.jpg,50.5,14.25,300,0.02\nb.jpg,50.6,14.26,301,\n"
# As Metashape 2 exports its reference pane.
METASHAPE = (
    "# Cameras (2)\n"
    '# CoordinateSystem: PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",AUTHORITY["EPSG","4326"]],'
    'AUTHORITY["EPSG","32633"]]\n'
    "#Label,X/Easting,Y/Northing,Z/Altitude,Error_(m),X_error,Y_error,Z_error,X_est,Y_est,Z_est\n"
    "a,458000.5,5550000.25,300,0.5,,,,,,\nb,,,,,,,,1,2,3\n# Total error\n"
)
METASHAPE_DEGREES = (
    '# CoordinateSystem: GEOGCS["WGS 84",DATUM["x"],AUTHORITY["EPSG","4326"]]\n'
    "#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_(m)\na,14.25,50.5,300,0.03\n"
)
ODM = "EPSG:4326\na.jpg 14.25 50.5 300 1 2 3 0.05 0.1\nb.jpg 14.26 50.6 301\n"


@pytest.mark.parametrize(
    ("name", "text", "degrees", "epsg", "places"),
    [
        (
            "gps.csv",
            DEGREES,
            True,
            4979,
            {"a.jpg": (50.5, 14.25, 300, (0.02,) * 3), "b.jpg": (50.6, 14.26, 301, None)},
        ),
        ("GPS.CSV", "Image;X;Y;Z\nA b.png;1;2;3.5\n", False, None, {"A b.png": (1, 2, 3.5, None)}),
        ("positions.csv", "x\ty\tz\tname\n1\t2\t3\t'q'\n", False, None, {"'q'": (1, 2, 3, None)}),
        ("reference.txt", METASHAPE, False, 32633, {"a": (458000.5, 5550000.25, 300, None)}),
        ("reference.csv", METASHAPE_DEGREES, True, 4979, {"a": (50.5, 14.25, 300, (0.03,) * 3)}),
        (
            "geo.txt",
            ODM,
            True,
            4979,
            {"a.jpg": (50.5, 14.25, 300, (0.05, 0.05, 0.1)), "b.jpg": (50.6, 14.26, 301, None)},
        ),
        (
            "geo.txt",
            "EPSG:32633\na.jpg 458000 5550000 300\n",
            False,
            32633,
            {"a.jpg": (458000, 5550000, 300, None)},
        ),
    ],
)
def test_a_table_is_read_with_its_accuracy_and_frame(tmp_path: Path, name, text, degrees, epsg, places):
    (tmp_path / name).write_text(text)
    assert position_files(tmp_path) == [tmp_path / name]
    table = read_position_table(tmp_path / name)
    assert (table.in_degrees, table.epsg) == (degrees, epsg)
    assert {key: (*place.place, place.accuracy_m) for key, place in table.places.items()} == places


@pytest.mark.parametrize(
    ("name", "text", "where"),
    [
        ("gps.csv", "a.jpg,50,14,300\n", "gps.csv"),
        ("gps.csv", "name,lat,alt\na.jpg,50,14\n", "gps.csv"),
        ("gps.csv", DEGREES + "c.jpg,91,14,0,1\n", "line 4"),
        ("gps.csv", DEGREES + "c.jpg,north,14,0,1\n", "line 4"),
        ("gps.csv", DEGREES + "c.jpg,nan,14,0,1\n", "line 4"),
        ("gps.csv", DEGREES + "c.jpg,1,14,0,-1\n", "line 4"),
        ("gps.csv", DEGREES + "a.jpg,1,14,0,1\n", "line 4"),
        ("geo.txt", "EPSG:4326\na.jpg 1\n", "line 2"),
        ("geo.txt", "EPSG:4326\na.jpg 1 2 3\nb.jpg 35.6 139.7 3\n", "line 3"),  # latitude first
        ("geo.txt", "EPSG:4326\na.jpg 458000 5550000 3\n", "line 2"),
        ("geo.txt", "+proj=tmerc +units=furlong\na.jpg 1 2 3\n", "line 1"),
        ("geo.txt", "WGS 84\na.jpg 1 2 3\n", "geo.txt"),
        ("gps.csv", "", "gps.csv"),
    ],
)
def test_a_bad_table_is_refused_with_the_line_and_what_to_write(tmp_path: Path, name, text, where):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_position_table(tmp_path / name)
    assert_complete(caught.value, "positions_invalid", where)
    assert ("EPSG:4326" if name == "geo.txt" else "name,lat,lon,alt") in caught.value.hint


@pytest.mark.parametrize(
    ("header", "row", "degrees", "epsg", "place"),
    [
        ("EPSG:4258", "11.5 48.1 520", True, 4258, (48.1, 11.5, 520)),
        ("\n \nEPSG: 4258", "11.5 48.1 520", True, 4258, (48.1, 11.5, 520)),
        ("epsg:4269", "11.5 48.1 520", True, 4269, (48.1, 11.5, 520)),
        ("EPSG:4171", "11.5 48.1 520", True, 4171, (48.1, 11.5, 520)),
        ("EPSG:9057", "-70.5 -48.1 520", True, 9057, (-48.1, -70.5, 520)),
        ("EPSG:4647", "32691000 5332000 520", False, 4647, (32691000, 5332000, 520)),
        ("EPSG:25832", "10 20 5", False, 25832, (10, 20, 5)),
        ("WGS84 UTM 32N", "691000 5332000 520", False, 32632, (691000, 5332000, 520)),
        ("WGS84 UTM 5s", "691000 5332000 520", False, 32705, (691000, 5332000, 520)),
        ("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", "1 2 3", False, 32632, (1, 2, 3)),
        ("'+proj=utm +zone=19 +south +datum=WGS84 +units=m +no_defs'", "1 2 3", False, 32719, (1, 2, 3)),
        ("+proj=longlat +datum=WGS84 +no_defs", "11.5 48.1 520", True, 4979, (48.1, 11.5, 520)),
        ("+proj=latlong +ellps=GRS80", "11.5 48.1 520", True, None, (48.1, 11.5, 520)),
        ("+proj=lcc +lat_1=33 +lat_2=45 +units=us-ft", "3937 0 3", False, None, (1200, 0, 3)),
        ("+proj=tmerc +lon_0=9 +to_meter=0.5", "4 2 3", False, None, (2, 1, 3)),
    ],
)
def test_every_form_of_opendronemaps_frame_is_read(tmp_path: Path, header, row, degrees, epsg, place):
    (tmp_path / "geo.txt").write_text(
        f"{header}\n# a comment\n\na.jpg {row} 1 2 3 0.05 0.1 extra\nb.jpg {row}\n"
    )
    table = read_position_table(tmp_path / "geo.txt")
    assert (table.in_degrees, table.epsg) == (degrees, epsg)
    assert table.places["a.jpg"].place == pytest.approx(place, rel=1e-12)
    assert [one.accuracy_m for one in table.places.values()] == [(0.05, 0.05, 0.1), None]


def test_positions_without_height_are_not_used_and_the_line_is_named(tmp_path: Path):
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.jpg 11 48 3\nb.jpg 11 48\nc.jpg 11 48\n")
    table = read_position_table(tmp_path / "geo.txt")
    assert list(table.places) == ["a.jpg"]
    assert table.notes == (
        "geo.txt line 3 has no height: 2 positions without one are not used, as places alone, without heights, do not "
        "tell how the scene is tilted",
    )


@pytest.mark.parametrize(
    ("text", "line", "flat", "known"),
    [
        ("name,lat,lon\na.jpg,50.5,14.25\nb.jpg,50.6,14.26\n", 2, 2, []),
        ("name,lat,lon,alt\na.jpg,50.5,14.25,300\nb.jpg,50.6,14.26,\n", 3, 1, ["a.jpg"]),
        ("name;x;y\na.jpg;1;2\n", 2, 1, []),
    ],
)
def test_rows_of_a_table_without_height_are_said_and_do_not_refuse_the_set(tmp_path, text, line, flat, known):
    (tmp_path / "gps.csv").write_text(text)
    table = read_position_table(tmp_path / "gps.csv")
    assert list(table.places) == known
    (note,) = table.notes
    assert note.startswith(f"gps.csv line {line} has no height: {flat} positions without one are not used")


def test_photos_whose_gps_has_no_altitude_are_counted(tmp_path: Path):
    scene = nerfstudio_scene(tmp_path)
    save(tmp_path, scene)
    assert not any("altitude" in text for text in read_dataset(tmp_path).warnings)
    paths = [tmp_path / row["file_path"] for row in scene["frames"]]
    for path in paths[1:]:
        tags = geotag(50.5, 14.25, 300.0)
        tags[0x8825] = {key: value for key, value in tags[0x8825].items() if key not in (5, 6)}
        Image.open(path).save(path, exif=tags)
    dataset = read_dataset(tmp_path)
    assert position_priors(dataset) is None
    (note,) = (text for text in dataset.warnings if "altitude" in text)
    assert note.startswith(
        f"{len(paths) - 1} of {len(paths)} photos have a GPS position without altitude, which is not"
    )


@pytest.mark.parametrize(
    ("frame", "degrees"),
    [
        ('GEOGCS["ETRS89",DATUM["x"],AUTHORITY["EPSG","4258"]]', True),
        ('COMPD_CS["WGS 84 + EGM96",GEOGCS["WGS 84",DATUM["x"]],VERT_CS["EGM96"]]', True),
        ('GEOGCRS["WGS 84",DATUM["x"]]', True),
        ('PROJCS["UTM",GEOGCS["WGS 84",DATUM["x"]]]', False),
        ('COMPD_CS["x",PROJCS["UTM",GEOGCS["WGS 84"]],VERT_CS["EGM96"]]', False),
        ('LOCAL_CS["Local Coordinates (m)"]', False),
        ('GEOCCS["WGS 84 geocentric"]', False),
    ],
)
def test_a_frame_in_text_form_is_of_degrees_or_metres(frame, degrees):
    assert is_geographic(frame) == degrees


LOGGER = "nord,east,alt,speed\n48.1088297,11.5051776,8.026,4.113\n"


def test_a_table_that_names_no_photo_is_said_and_the_next_one_is_used(tmp_path: Path):
    save(tmp_path, nerfstudio_scene(tmp_path))
    (tmp_path / "gps.csv").write_text(LOGGER)
    (tmp_path / "geo.txt").write_text("EPSG:4326\n000.jpg 11 48 3\n001.jpg 11.1 48 3\n")
    dataset = read_dataset(tmp_path)
    assert dataset.posed.all()
    assert any("gps.csv has no header" in text and "names no photo" in text for text in dataset.warnings)
    assert any("geo.txt: measured positions of 2 of 4" in text for text in dataset.warnings)
    priors = position_priors(dataset)
    assert priors is not None
    assert priors.rows.tolist() == [0, 1]
    (tmp_path / "gps.csv").write_text(LOGGER + "1,2,3,000.jpg\n")  # it is about these photos
    with pytest.raises(InputError, match="no header"):
        read_dataset(tmp_path)


def test_other_tables_are_none_of_positions(tmp_path: Path):
    (tmp_path / "poses.csv").write_text(DEGREES)
    assert position_files(tmp_path) == []

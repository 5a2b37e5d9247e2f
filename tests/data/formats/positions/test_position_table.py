"""Tables of positions as people and programs write them are read with their accuracy, or refused with the line."""

from __future__ import annotations

from pathlib import Path

import pytest

from biresnerf.data.formats.positions.position_table import position_file, read_position_table
from biresnerf.errors import InputError
from tests.data.scenes import assert_complete

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
            {"a.jpg": (50.5, 14.25, 300, 0.02), "b.jpg": (50.6, 14.26, 301, None)},
        ),
        ("GPS.CSV", "Image;X;Y;Z\nA b.png;1;2;3.5\n", False, None, {"A b.png": (1, 2, 3.5, None)}),
        ("positions.csv", "x\ty\tz\tname\n1\t2\t3\t'q'\n", False, None, {"'q'": (1, 2, 3, None)}),
        ("reference.txt", METASHAPE, False, 32633, {"a": (458000.5, 5550000.25, 300, None)}),
        ("reference.csv", METASHAPE_DEGREES, True, 4979, {"a": (50.5, 14.25, 300, 0.03)}),
        ("geo.txt", ODM, True, 4979, {"a.jpg": (50.5, 14.25, 300, 0.05), "b.jpg": (50.6, 14.26, 301, None)}),
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
    found = position_file(tmp_path)
    assert found == tmp_path / name
    table = read_position_table(found)
    assert (table.in_degrees, table.epsg) == (degrees, epsg)
    assert {key: (*place.place, place.accuracy_m) for key, place in table.places.items()} == places


@pytest.mark.parametrize(
    ("name", "text", "where"),
    [
        ("gps.csv", "a.jpg,50,14,300\n", "gps.csv"),
        ("gps.csv", "name,lat,lon\na.jpg,50,14\n", "gps.csv"),
        ("gps.csv", DEGREES + "c.jpg,91,14,0,1\n", "line 4"),
        ("gps.csv", DEGREES + "c.jpg,north,14,0,1\n", "line 4"),
        ("gps.csv", DEGREES + "c.jpg,nan,14,0,1\n", "line 4"),
        ("gps.csv", DEGREES + "c.jpg,1,14,0,-1\n", "line 4"),
        ("gps.csv", DEGREES + "a.jpg,1,14,0,1\n", "line 4"),
        ("geo.txt", "EPSG:4326\na.jpg 1 2\n", "line 2"),
        ("gps.csv", "", "gps.csv"),
    ],
)
def test_a_bad_table_is_refused_with_the_line_and_what_to_write(tmp_path: Path, name, text, where):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_position_table(tmp_path / name)
    assert_complete(caught.value, "positions_invalid", where)
    assert "name,lat,lon,alt" in caught.value.hint


def test_other_tables_are_none_of_positions(tmp_path: Path):
    (tmp_path / "poses.csv").write_text(DEGREES)
    assert position_file(tmp_path) is None

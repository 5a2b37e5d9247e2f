"""The page has the right headers for caching and confinement."""

from __future__ import annotations

import asyncio
import re
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest

from biresnerf.data.model.untrusted_file import read_json_object
from biresnerf.data.show.view_file import read_view_file
from biresnerf.data.show.view_pictures import read_points
from biresnerf.viewer.report_html import read_report
from service import web_page
from service.app import create_app
from tests.service.conftest import Running, client_with, problem
from workers.settings.settings import Settings


@pytest.fixture
def parts(http: httpx.Client) -> list[str]:
    found = re.findall(r'(?:src|href)="(web/[^"]+)"', http.get("/").text)
    assert {Path(name).suffix for name in found} == {".js", ".css", ".svg"}
    return found


def test_the_page_is_asked_for_each_time_and_may_load_nothing_from_elsewhere(http: httpx.Client) -> None:
    answer = http.get("/")
    assert answer.headers["content-type"].startswith("text/html")
    assert answer.headers["cache-control"] == "no-cache"
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    allowed = {word for words in policy.values() for word in words.split()}
    assert allowed == {"'self'", "'none'", "blob:", "data:"}


def test_its_parts_are_kept_for_good(http: httpx.Client, parts: list[str]) -> None:
    for name in parts:
        answer = http.get(f"/{name}")
        assert answer.headers["cache-control"] == "public, max-age=31536000, immutable", name
        assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_script_is_sent_compressed_to_those_who_take_it(http: httpx.Client, parts: list[str]) -> None:
    script = next(name for name in parts if name.endswith(".js"))
    plain = http.get(f"/{script}", headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers
    for encoding in ("gzip", "br"):
        headers = {"Accept-Encoding": encoding}
        with http.stream("GET", f"/{script}", headers=headers) as answer:
            sent = b"".join(answer.iter_raw())
            assert answer.headers["content-encoding"] == encoding
        assert len(sent) < len(plain.content) / 2
        if encoding == "gzip":
            assert http.get(f"/{script}", headers=headers).content == plain.content


@pytest.mark.parametrize(
    "name", ["index.html", "built-from", "app.js", "..%2Fapp.tsx", "app-AAAAAAAA.js", "app-AAAAAAAA.js.br"]
)
def test_nothing_but_the_parts_is_answered(http: httpx.Client, name: str) -> None:
    problem(http.get(f"/web/{name}"), 404, "not_found")


def test_the_page_needs_no_key_since_it_asks_for_one(closed: Running) -> None:
    with client_with(closed, None) as stranger:
        page = stranger.get("/")
        assert page.status_code == 200
        script = re.search(r'src="(web/[^"]+)"', page.text)
        assert script is not None
        assert stranger.get(f"/{script[1]}").status_code == 200
        problem(stranger.get("/v1/jobs"), 401, "missing_credentials")


def test_the_example_reads_as_a_result_and_is_small() -> None:
    report, view = read_report(web_page.EXAMPLE), read_view_file(web_page.EXAMPLE)
    assert report.verdict is not None
    assert report.verdict.verdict == "improved"
    poses = read_json_object(web_page.EXAMPLE / view.poses)
    assert [image["name"] for image in poses["images"]] == [image.name for image in report.images]
    assert all(len(read_points(web_page.EXAMPLE, points)[0]) for points in view.points)
    assert view.orbit is not None
    assert sum(path.stat().st_size for path in web_page.EXAMPLE.rglob("*") if path.is_file()) < 1_000_000


def test_the_examples_colmap_model_has_the_refined_poses(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    with zipfile.ZipFile(web_page.EXAMPLE / "colmap.zip") as archive:
        archive.extractall(tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "colmap/sparse/0")
    in_model = {Path(one.name): one.cam_from_world().inverse().matrix() for one in model.images.values()}
    poses = read_json_object(web_page.EXAMPLE / "poses.json")
    refined = {Path(image["file_name"]): image["world_from_cam"] for image in poses["images"]}
    assert in_model.keys() == refined.keys()
    for name, world_from_cam in in_model.items():
        np.testing.assert_allclose(world_from_cam, np.asarray(refined[name])[:3], atol=1e-6)


def test_the_example_is_answered_whole_to_those_without_a_key_and_nothing_else_is(closed: Running) -> None:
    view = read_view_file(web_page.EXAMPLE)
    assert view.contact_sheet is not None
    named = {view.poses, "report.json", "history.jsonl", view.contact_sheet.file}
    named |= {points.file for points in view.points} | {str(view.orbit), "colmap.zip", "transforms.json"}
    named |= {file for shown in view.views for file in shown.pictures.files().values()}
    with client_with(closed, None) as stranger:
        for name in named:
            answer = stranger.get(f"/example/{name}")
            assert answer.content == (web_page.EXAMPLE / name).read_bytes(), name
            assert answer.headers["x-content-type-options"] == "nosniff"
        for name in ("", "..%2fapp.py", "%2fetc%2fpasswd", "renders", "other.json"):
            problem(stranger.get(f"/example/{name}"), 404, "not_found")


def test_a_tree_without_the_built_page_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_page, "FOLDER", tmp_path)

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app=create_app(Settings()))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.get("/")

    assert "make web" in problem(asyncio.run(ask()), 503, "unavailable")["hint"]

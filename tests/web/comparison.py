"""The page's comparison of two jobs, against their files."""

from __future__ import annotations

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from biresnerf.comparison.compare_results import compare_results
from biresnerf.data.formats.simple.poses_json import PosesDocument
from biresnerf.geometry.similarity import align_robust
from biresnerf.report import Report


def expect_compared(page: Page, api: httpx.Client, first_job: str, second_job: str) -> None:
    """The comparison of a job of ten photos with its fork that had more steps for the verdict."""
    boxes = page.get_by_role("checkbox", name="Select kitchen")
    expect(boxes).to_have_count(2)
    for box in boxes.all():
        box.check()
    page.get_by_role("link", name="Compare").click()
    expect(page.get_by_role("region", name="Conclusion")).to_be_visible()
    # The page lists jobs by age, whichever was ticked first.
    in_order = page.url.rpartition("/compare/")[2].split("/")
    assert sorted(in_order) == sorted((first_job, second_job))
    first, second = (files_of(api, job) for job in in_order)
    expect_conclusion(page, first, second)
    figures = page.get_by_role("region", name="Figures of both jobs")
    expect(figures.get_by_role("row").filter(has_text="Option “Steps of the verdict”")).to_contain_text(
        "100000"
    )
    expect(page.get_by_role("img", name="PSNR of the training views")).to_be_visible()
    expect_differences(page, first[1], second[1])


def expect_conclusion(
    page: Page, first: tuple[Report, PosesDocument], second: tuple[Report, PosesDocument]
) -> None:
    """The page has the library's words, and marks what speaks for either; rows that agree are not there."""
    said = compare_results(first, second)
    conclusion = page.get_by_role("region", name="Conclusion")
    expect(conclusion).to_contain_text(said.conclusion)
    assert conclusion.get_by_role("listitem").all_inner_texts() == list(said.why)
    rows = page.get_by_role("region", name="Figures of both jobs").get_by_role("row").all()[1:]
    assert [row.get_by_role("rowheader").inner_text() for row in rows] == [each.name for each in said.figures]
    for row, figure in zip(rows, said.figures, strict=True):
        cells = [text.split() for text in row.get_by_role("cell").all_inner_texts()]
        for cell, value, side in zip(cells, (figure.first, figure.second), ("first", "second"), strict=True):
            assert cell == value.split() + ["better"] * (figure.better == side)


def expect_differences(page: Page, first: PosesDocument, second: PosesDocument) -> None:
    """The table's first row, with the photo that is turned most."""
    differing = page.get_by_role("region", name="Differences of poses").get_by_role("row")
    expect(differing).to_have_count(11)
    a, b = (
        np.array([[*image.world_from_cam, (0, 0, 0, 1)] for image in poses.images])
        for poses in (first, second)
    )
    b = align_robust(b, a, with_rotations=True).apply_to_poses(b)
    cells = differing.nth(1).get_by_role("cell").all_inner_texts()
    name = differing.nth(1).get_by_role("rowheader").inner_text()
    number = [image.name for image in first.images].index(name)
    distance = np.linalg.norm(a[number, :3, 3] - b[number, :3, 3])
    assert float(cells[1]) == pytest.approx(distance, rel=0.01, abs=1e-3)
    traces = np.trace(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3], axis1=1, axis2=2)
    turned = np.degrees(np.arccos(np.minimum(1.0, (traces - 1) / 2)))
    assert float(cells[0]) == pytest.approx(turned[number], rel=0.02, abs=1e-3)
    assert turned[number] == pytest.approx(turned.max(), abs=1e-5)


def files_of(api: httpx.Client, job: str) -> tuple[Report, PosesDocument]:
    """What the job returned."""
    report, poses = (
        api.get(f"/jobs/{job}/artifacts/{name}", follow_redirects=True).content
        for name in ("report.json", "poses.json")
    )
    return Report.model_validate_json(report), PosesDocument.model_validate_json(poses)

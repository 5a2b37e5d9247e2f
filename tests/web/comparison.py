"""What the page says of two jobs, against their own files."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect


def expect_compared(page: Page, api: httpx.Client, first_job: str, second_job: str) -> None:
    """The comparison of a job of ten photos with its fork that had more steps for the verdict."""
    boxes = page.get_by_role("checkbox", name="Select kitchen")
    expect(boxes).to_have_count(2)
    for box in boxes.all():
        box.check()
    page.get_by_role("link", name="Compare").click()
    figures = page.get_by_role("region", name="Figures of both jobs")
    expect(figures.get_by_role("row").filter(has_text="Option “Steps of the verdict”")).to_contain_text(
        "100000"
    )
    expect(page.get_by_role("img", name="PSNR of the training views")).to_be_visible()
    differing = page.get_by_role("region", name="Differences of poses").get_by_role("row")
    expect(differing).to_have_count(11)
    by_name = [
        {image["name"]: image["world_from_cam"] for image in poses["images"]}
        for poses in (refined_poses(api, one) for one in (first_job, second_job))
    ]
    cells = differing.nth(1).get_by_role("cell").all_inner_texts()
    name = differing.nth(1).get_by_role("rowheader").inner_text()
    first, second = (np.array(poses[name]) for poses in by_name)
    assert float(cells[1]) == pytest.approx(np.linalg.norm(first[:3, 3] - second[:3, 3]), rel=0.01)
    trace = np.trace(first[:3, :3].T @ second[:3, :3])
    assert float(cells[0]) == pytest.approx(
        np.degrees(np.arccos(min(1.0, (trace - 1) / 2))), rel=0.02, abs=1e-3
    )


def refined_poses(api: httpx.Client, job: str) -> dict[str, Any]:
    """The poses that the job refined, whatever its verdict."""
    names = {item["name"] for item in api.get(f"/jobs/{job}/artifacts").json()["items"]}
    file = "refined/poses.json" if "refined/poses.json" in names else "poses.json"
    found: dict[str, Any] = api.get(f"/jobs/{job}/artifacts/{file}", follow_redirects=True).json()
    return found

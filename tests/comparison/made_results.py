"""Results made from true poses: their errors are known, and their figures follow from these."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from biresnerf.comparison.compare_results import compare_results
from biresnerf.comparison.conclusion import Comparison
from biresnerf.data.formats.simple.poses_json import POSES, PoseImage, PosesDocument, read_poses_json
from biresnerf.geometry.similarity import Similarity
from biresnerf.report import EpipolarEvidence, HeldOutEvidence, ImageReport, PairedDifference, Report, Verdict
from biresnerf.uncertainty import PoseUncertainty
from biresnerf.viewer.report_html import read_report

EXAMPLE = Path(__file__).parents[2] / "service/example"
REPORT, TRUTH = read_report(EXAMPLE), read_poses_json(EXAMPLE / POSES)
PX_PER_DEG = 2.0  # of matching error; 0.3 px of noise are in it at true poses
Made = tuple[Report, PosesDocument]


def compared(first: Made, second: Made) -> Comparison:
    """The comparison, after the swapped one was seen to say the same the other way round."""
    forth, back = compare_results(first, second), compare_results(second, first)
    turned = {"first": "second", "second": "first"}
    assert back.outcome == turned.get(forth.outcome, forth.outcome)
    assert (back.contradict, back.photos) == (forth.contradict, forth.photos)
    assert [each.name for each in back.figures] == [each.name for each in forth.figures]
    return forth


def made(
    off_deg: float, bound_deg: float | None, seed: int, *, keep: int | None = None, **changes: Any
) -> Made:
    """A result whose poses are the true ones turned at random by about so much, and what it says of itself.

    Matches see how far poses are off; unseen views lose 2 dB a degree.
    `keep`: only so many photos; `judged`: the verdict's name; `changes`: its other fields, or all of it as `verdict`.
    """
    random = np.random.default_rng(seed)
    truth = TRUTH.images[:keep]
    turns = Rotation.from_rotvec(np.radians(off_deg) * random.standard_normal((len(truth), 3)) / 3**0.5)
    off = np.degrees(turns.magnitude())
    poses = tuple(_turned(image, turn) for image, turn in zip(truth, turns.as_matrix(), strict=True))
    px = np.hypot(0.3 + 0.02 * random.standard_normal(len(truth)), PX_PER_DEG * off)
    known = _uncertainty(bound_deg)
    views = 25.0 - 2.0 * off + 0.1 * random.standard_normal(len(truth))
    images = tuple(
        ImageReport(
            **{
                "name": image.name,
                "pose_source": "given",
                "held_out": False,
                "moved_deg": 5.0,
                "moved_units": 0.1,
            },
            uncertainty=known,
            epipolar_px_before=20.0,
            epipolar_px_after=float(px[n]),
            trial_psnr_before=15.0 if n < 8 else None,
            trial_psnr_after=float(views[n]) if n < 8 else None,
        )
        for n, image in enumerate(truth)
    )
    report = REPORT.model_copy(
        update={"images": images, "verdict": _verdict(float(np.median(px)), float(views[:8].mean()))}
    )
    if "judged" in changes:
        changes["verdict"] = report.verdict and report.verdict.model_copy(
            update={"verdict": changes.pop("judged")}
        )
    if "verdict" in changes:
        report = report.model_copy(update={"verdict": changes.pop("verdict")})
    if changes and report.verdict:
        report = report.model_copy(update={"verdict": report.verdict.model_copy(update=changes)})
    document = TRUTH.model_copy(
        update={"images": tuple(p.model_copy(update={"uncertainty": known}) for p in poses)}
    )
    return report, document


def in_frame(result: Made, frame: Similarity) -> Made:
    """The same result in another world."""
    report, document = result
    moved = []
    for image in document.images:
        pose = np.vstack([image.world_from_cam, [0, 0, 0, 1]])
        rows = tuple(map(tuple, frame.apply_to_poses(pose)[:3].tolist()))
        known = image.uncertainty
        if known is not None and known.position is not None:
            known = known.model_copy(update={"position": frame.scale * known.position})
        moved.append(image.model_copy(update={"world_from_cam": rows, "uncertainty": known}))
    return report, document.model_copy(update={"images": tuple(moved)})


def with_images(result: Made, change: dict[str, Any], numbers: range) -> Made:
    """The result with fields of these photos changed."""
    report, document = result
    images = [i.model_copy(update=change) if n in numbers else i for n, i in enumerate(report.images)]
    return report.model_copy(update={"images": tuple(images)}), document


def with_turned(result: Made, degrees: float, numbers: range) -> Made:
    """The result with these photos turned about their own centres."""
    report, document = result
    turn = Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    images = [_turned(image, turn) if n in numbers else image for n, image in enumerate(document.images)]
    return report, document.model_copy(update={"images": tuple(images)})


def _turned(image: PoseImage, turn: np.ndarray) -> PoseImage:
    pose = np.array(image.world_from_cam)
    pose[:, :3] = pose[:, :3] @ turn
    return image.model_copy(update={"world_from_cam": tuple(map(tuple, pose.tolist()))})


def _uncertainty(bound_deg: float | None) -> PoseUncertainty:
    if bound_deg is None:
        return PoseUncertainty(known_from="nothing", why_unknown="no feature matches or patches support them")
    return PoseUncertainty(known_from="matches", rotation_deg=bound_deg, position=0.05)


def _verdict(px: float, decibels: float) -> Verdict:
    def figure(before: float, after: float, gain: float) -> PairedDifference:
        return PairedDifference(count=8, before=before, after=after, difference=gain, finding="better")

    return Verdict(
        verdict="improved", returned="refined", compared_with="given", why=("It is better.",), moved_px=5.0,
        heldout=HeldOutEvidence(
            steps=200, strictly=3, psnr=figure(15.0, decibels, decibels - 15.0), ssim=figure(0.3, 0.6, 0.3)
        ),
        epipolar=EpipolarEvidence(
            matches=4000, independent=True, error_px=figure(20.0, px, 4.0), share_of_image=px / 160
        ),
    )  # fmt: skip

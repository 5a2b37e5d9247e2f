"""What answers look like, for the OpenAPI document: by the name of their schema. A test holds them to it."""

from __future__ import annotations

from typing import Any

from biresnerf.options.presets import PRESETS, ComputeDevice
from biresnerf.options.refine_options import RefineOptions
from service.docs.webhook_examples import WEBHOOK_EXAMPLES

_AT = "2026-11-21T19:00:00Z"
_SHA256 = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
_DATASET_ID, _JOB_ID = "ds_01JD8Y3V1QKZ5M0C7W2N4T6XAB", "job_01JD8Y3V1QKZ5M0C7W2N4T6XAB"
_DATASET, _JOB = f"/v1/datasets/{_DATASET_ID}", f"/v1/jobs/{_JOB_ID}"
_ASKED = RefineOptions(preset="fast")
_OPTIONS = _ASKED.resolved("cpu").model_dump(mode="json")


def _presets(device: ComputeDevice) -> dict[str, Any]:
    return {name: RefineOptions(preset=name).resolved(device).model_dump(mode="json") for name in PRESETS}


_JOB_VIEW: dict[str, Any] = {
    "id": _JOB_ID,
    "dataset_id": _DATASET_ID,
    "state": "running",
    "stage": "coarse",
    "progress": {"fraction": 0.31, "step": 620, "steps_total": 2000, "eta_s": 71.5},
    "queue_position": None,
    "attempt": 1,
    "cancel_requested": False,
    "created_at": _AT,
    "started_at": "2026-11-21T19:00:02Z",
    "finished_at": None,
    "options": _ASKED.model_dump(mode="json", exclude_unset=True),
    "resolved_options": _OPTIONS,
    "metrics": {"loss": 0.012, "psnr": 19.2},
    "message": "",
    "verdict": None,
    "error": None,
    "labels": {"run": "a"},
    "revision": 17,
    "links": {
        "self": _JOB,
        "dataset": _DATASET,
        "events": f"{_JOB}/events",
        "artifacts": f"{_JOB}/artifacts",
        "report": f"{_JOB}/report",
        "images": f"{_JOB}/images",
        "logs": f"{_JOB}/logs",
        "exports": f"{_JOB}/exports",
        "cancel": f"{_JOB}/cancel",
        "fork": f"{_JOB}/fork",
    },
}
_DATASET_VIEW: dict[str, Any] = {
    "id": _DATASET_ID,
    "name": "kitchen",
    "state": "ready",
    "files": 61,
    "bytes": 48_211_034,
    "missing": [],
    "report": {
        **{"images": 60, "with_pose": 60, "without_pose": 0, "poses": "given"},
        **{"cameras": 1, "camera_models": ["OPENCV"], "intrinsics": ["given"], "format": "nerfstudio"},
        **{"masks": 0, "transparency": False, "warnings": []},
    },
    "error": None,
    "created_at": _AT,
    "revision": 63,
    "links": {
        "self": _DATASET,
        "files": f"{_DATASET}/files",
        "archive": f"{_DATASET}/archive",
        "finalize": f"{_DATASET}/finalize",
        "uploads": f"{_DATASET}/uploads",
    },
}
_FILE_VIEW = {"path": "images/0001.jpg", "size": 803_120, "sha256": _SHA256, "created_at": _AT}
_ARTIFACT_VIEW = {
    "name": "transforms.json",
    "size": 41_305,
    "sha256": _SHA256,
    "media_type": "application/json",
    "href": f"{_JOB}/artifacts/transforms.json",
}
_DIFFERENCE = {"before": 21.4, "after": 24.9, "difference": 3.5, "low": 2.9, "high": 4.1, "finding": "better"}
_REPORT: dict[str, Any] = {
    "version": "0.1.0",
    "state": "complete",
    "options": _OPTIONS,
    "verdict": {
        "verdict": "improved",
        "returned": "refined",
        "compared_with": "given",
        "why": ["Unseen views are predicted 3.50 dB better (95 %: 2.90 to 4.10)."],
        "moved_px": 4.2,
        "heldout": {
            "steps": 1000,
            "strictly": 6,
            "psnr": {"count": 18, **_DIFFERENCE},
            "ssim": {"count": 18, **_DIFFERENCE, "before": 0.71, "after": 0.8, "difference": 0.09},
        },
    },
    "images": [
        {
            "name": "images/0001.jpg",
            "pose_source": "given",
            "held_out": False,
            "moved_deg": 1.31,
            "moved_units": 0.042,
        }
    ],
    "cameras": [
        {
            "model": "OPENCV",
            "width": 1920,
            "height": 1080,
            "source": "given",
            "refined": "none",
            "images": 60,
            "params_before": [1500.0, 1500.0, 960.0, 540.0, 0.01, -0.02, 0.0, 0.0],
            "params_after": [1500.0, 1500.0, 960.0, 540.0, 0.01, -0.02, 0.0, 0.0],
        }
    ],
    "heldout": {"count": 6, "psnr": 26.1, "ssim": 0.84},
    "steps_done": 2000,
    "switch_step": 700,
    "switch_reason": "stable",
    "seconds": {"coarse": 40.1, "fine": 71.9},
    "backend": "numba",
    "device": "cpu",
    "threads": 8,
    "working_size": [160, 90],
    "input_from_optimised": {
        "scale": 2.4,
        "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "translation": [0.1, 0.0, -0.2],
    },
    "points": {"source": "features", "count": 5210},
}

_UPLOAD_VIEW: dict[str, Any] = {
    "id": "up_01JD8Y3V1QKZ5M0C7W2N4T6XAB",
    "dataset_id": _DATASET_ID,
    "kind": "archive",
    "path": None,
    "size": 48_211_034,
    "sha256": _SHA256,
    "state": "receiving",
    "received": 16_777_216,
    "error": None,
    "created_at": _AT,
    "expires_at": "2026-11-22T19:00:00Z",
}

EXAMPLES: dict[str, Any] = {
    **WEBHOOK_EXAMPLES,
    "JobView": _JOB_VIEW,
    "JobList": {"items": [_JOB_VIEW], "next_cursor": None},
    "DatasetView": _DATASET_VIEW,
    "DatasetList": {"items": [_DATASET_VIEW], "next_cursor": None},
    "UploadView": _UPLOAD_VIEW,
    "SignedUploads": {
        "items": [
            {
                "upload": {**_UPLOAD_VIEW, "kind": "signed", "path": "a.jpg", "size": 803_120, "received": 0},
                "url": "https://s3.example.org/bucket/datasets/…/content?X-Amz-Signature=…",
            }
        ]
    },
    "ShareView": {
        "name": "transforms.json",
        "href": f"/v1/shared/{_JOB_ID}/transforms.json?expires=1795291200&signature=kq0h…",
        "expires_at": _AT,
    },
    "FileView": _FILE_VIEW,
    "FileList": {"items": [_FILE_VIEW], "next_cursor": None},
    "ArtifactView": _ARTIFACT_VIEW,
    "ArtifactList": {"items": [_ARTIFACT_VIEW]},
    "Report": _REPORT,
    "ImageList": {
        "partial": False,
        "items": [
            {
                **_REPORT["images"][0],
                "trial_psnr_before": 21.4,
                "trial_psnr_after": 24.9,
                "delta_psnr": 3.5,
            }
        ],
    },
    "Health": {"status": "ok"},
    "Info": {
        "name": "biresnerf",
        "version": "0.1.0",
        "limits": {
            "max_files": 1000,
            "max_file_bytes": 67_108_864,
            "max_dataset_bytes": 8_589_934_592,
            "max_archive_bytes": 8_589_934_592,
            "max_unpacked_bytes": 21_474_836_480,
            "max_archive_ratio": 200.0,
            "job_timeout_s": 7200.0,
            "check_timeout_s": 900.0,
        },
        "archives": ["application/zip", "application/x-tar", "application/gzip"],
        "job_counts": {"queued": 2, "running": 1, "succeeded": 40},
        "share": {
            "id": "anna",
            "weight": 1.0,
            "top_priority": "normal",
            "max_running": 2,
            "max_queued": 100,
            "max_stored_bytes": 107_374_182_400,
            "running": 1,
            "queued": 2,
            "stored_bytes": 1_288_490_188,
        },
    },
    "OptionsView": {
        "json_schema": {"type": "object", "properties": {"steps": {"type": "integer"}}},
        "presets": _presets("cpu"),
        "presets_on_gpu": _presets("cuda"),
    },
}

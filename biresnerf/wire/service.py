"""What a service says of itself."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from biresnerf.options.presets import PresetName
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.wire.base import Record
from biresnerf.wire.jobs import JobState, PriorityName


class TenantShare(Record):
    """What a tenant may use and what it uses. A limit of 0 is none."""

    id: str
    weight: float = Field(description="Share of the slots where tenants wait for them; 1 is usual.")
    top_priority: PriorityName = Field(description="The highest priority its jobs may ask for.")
    max_running: int = Field(description="Jobs at the same time.")
    max_queued: int = Field(description="Jobs that wait.")
    max_stored_bytes: int = Field(description="Bytes of datasets, uploads and results together.")
    running: int
    queued: int
    stored_bytes: int


class OptionsView(Record):
    """What may be asked for: the JSON Schema of `options`, and every preset with all values filled in.

    In the schema each option also has `stage`, the first whose work depends on it; `changes_result`; and `level`:
    `usual`, `expert` or `research`.
    """

    json_schema: dict[str, Any]
    presets: dict[PresetName, ResolvedOptions] = Field(description="As resolved by a worker without a GPU.")
    presets_on_gpu: dict[PresetName, ResolvedOptions] = Field(
        description="As resolved by a worker with a GPU."
    )


class SizeLimits(Record):
    """What the service takes."""

    max_files: int
    max_file_bytes: int
    max_dataset_bytes: int
    max_archive_bytes: int
    max_unpacked_bytes: int
    max_archive_ratio: float
    job_timeout_s: float
    check_timeout_s: float


class Info(Record):
    """What this service is."""

    name: Literal["biresnerf"] = "biresnerf"
    version: str
    limits: SizeLimits
    archives: list[str]
    job_counts: dict[JobState, int]
    share: TenantShare = Field(description="What you may use, and what you use. A limit of 0 is none.")


class Health(Record):
    """The answer of a healthy process."""

    status: Literal["ok"] = "ok"

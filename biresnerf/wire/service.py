"""What a service reports about itself."""

from __future__ import annotations

from datetime import date
from typing import Any, Literal

from pydantic import Field

from biresnerf.options.presets import PresetName
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.wire.base import Record
from biresnerf.wire.jobs import JobState, PriorityName


class TenantShare(Record):
    """The limits and the usage of a tenant. A limit of 0 means no limit."""

    id: str = Field(examples=["anna"])
    weight: float = Field(
        examples=[1.0], description="Share of the worker slots when tenants compete for them; 1 by default."
    )
    top_priority: PriorityName = Field(
        examples=["normal"], description="The highest priority its jobs may have."
    )
    max_running: int = Field(examples=[2], description="Jobs that may run at the same time.")
    max_queued: int = Field(examples=[100], description="Jobs that may wait.")
    max_stored_bytes: int = Field(
        examples=[107_374_182_400], description="Bytes of datasets, uploads and results together."
    )
    max_daily_seconds: int = Field(
        examples=[0], description="Seconds that its jobs may run in a day (UTC), added up."
    )
    running: int = Field(examples=[1])
    queued: int = Field(examples=[2])
    stored_bytes: int = Field(examples=[1_288_490_188])
    seconds_today: float = Field(examples=[840.2])


UsageKey = Literal["day", "tenant", "key", "device"]


class UsageRow(Record):
    """What attempts that ended in a period used. Fields that the rows are not split by are null."""

    day: date | None = Field(None, description="In UTC.")
    tenant: str | None = Field(None, examples=["anna"])
    key_id: str | None = Field(None, description="The API key that submitted the jobs; empty without one.")
    device: Literal["cpu", "gpu"] | None = Field(None, examples=["gpu"])
    attempts: int = Field(examples=[12])
    processor_s: float = Field(examples=[4100.5], description="User and system seconds of their processes.")
    wall_s: float = Field(examples=[2300.1])
    gpu_s: float = Field(examples=[2300.1], description="Of `wall_s`, on slots with a GPU.")


class UsageList(Record):
    """Usage in a period."""

    items: tuple[UsageRow, ...]


class OptionsView(Record):
    """The JSON Schema of `options`, and every preset with all values filled in.

    In the schema each option also has `stage`, the first whose work depends on it; `changes_result`; and `level`:
    `usual`, `expert` or `research`.
    """

    json_schema: dict[str, Any] = Field(
        examples=[{"type": "object", "properties": {"steps": {"type": "integer"}}}]
    )
    presets: dict[PresetName, ResolvedOptions] = Field(description="As resolved by a worker without a GPU.")
    presets_on_gpu: dict[PresetName, ResolvedOptions] = Field(
        examples=[{}], description="As resolved by a worker with a GPU."
    )


class SizeLimits(Record):
    """Size and time limits of the service."""

    max_files: int = Field(examples=[1000])
    max_file_bytes: int = Field(examples=[67_108_864])
    max_dataset_bytes: int = Field(examples=[8_589_934_592])
    max_archive_bytes: int = Field(examples=[8_589_934_592])
    max_unpacked_bytes: int = Field(examples=[21_474_836_480])
    max_archive_ratio: float = Field(examples=[200.0])
    job_timeout_s: float = Field(examples=[7200.0])
    check_timeout_s: float = Field(examples=[900.0])


class Info(Record):
    """Version, limits and load of the service."""

    name: Literal["biresnerf"] = "biresnerf"
    version: str = Field(examples=["0.1.0"])
    limits: SizeLimits
    archives: list[str] = Field(examples=[["application/zip", "application/x-tar", "application/gzip"]])
    job_counts: dict[JobState, int] = Field(examples=[{"queued": 2, "running": 1, "succeeded": 40}])
    workers: int = Field(examples=[2], description="Worker slots that are alive.")
    scopes: list[str] = Field(
        examples=[["read", "jobs:write"]],
        description="What your key permits; everything where none is needed.",
    )
    share: TenantShare = Field(description="Your limits and your usage. A limit of 0 means no limit.")


class Health(Record):
    """The response of a healthy process."""

    status: Literal["ok"] = "ok"

"""What clients send about a job that is there."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from biresnerf.config import PackName, RefineOptions
from service.schemas import Labels, Wire
from workers.forks import WantedStage


class CancelJob(Wire):
    """How a job is to end."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"keep_partial": True}]})

    keep_partial: bool = Field(
        False,
        description="Publish the best poses so far, with a report whose state is `partial`; else only the log.",
    )


class ForkJob(Wire):
    """What is to be different in a job that takes over the work of another."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"options": {"warmup_steps": 200}, "from_stage": "coarse"}]}
    )

    options: RefineOptions = Field(
        RefineOptions(), description="Those to be different; all others stay as they were asked for."
    )
    from_stage: WantedStage = Field(
        "auto",
        description="Whose work is taken over: COLMAP's answer (`seeding`), poses and field at the end of stage 1 "
        "(`coarse`), or the latest that the options allow.",
    )
    labels: Labels = Field(default_factory=dict)


class NewExport(Wire):
    """Forms to write a result in, beside those it has."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"formats": ["kitti", "pinhole"]}]})

    formats: list[PackName] = Field(min_length=1, max_length=20)

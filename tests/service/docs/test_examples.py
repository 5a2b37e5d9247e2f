"""Models' examples are built from those of their fields."""

from __future__ import annotations

import pytest
from pydantic import BaseModel, Field, ValidationError

from biresnerf.wire.jobs import JobView
from service.docs.examples import example_of


class Wheel(BaseModel):
    size: int = Field(examples=[26])


class Bicycle(BaseModel):
    wheels: tuple[Wheel, ...]
    spare: Wheel | None = None
    bell: bool


def test_models_inside_a_model_are_shown_even_where_they_may_lack() -> None:
    assert example_of(Bicycle) == {"wheels": [{"size": 26}], "spare": {"size": 26}, "bell": False}


def test_a_field_without_an_example_is_named() -> None:
    class Rider(BaseModel):
        name: str

    class Race(BaseModel):
        riders: list[Rider]

    with pytest.raises(LookupError, match=r"Race\.riders: Rider\.name: .*needs an example"):
        example_of(Race)


def test_an_example_that_its_model_refuses_is_an_error() -> None:
    class Tyre(BaseModel):
        pressure: int = Field(ge=1, examples=[0])

    with pytest.raises(ValidationError):
        example_of(Tyre)


def test_the_example_of_a_job_links_to_that_job() -> None:
    job = example_of(JobView)
    assert job["links"]["self"].endswith(job["id"])
    assert job["progress"]["step"] == 620

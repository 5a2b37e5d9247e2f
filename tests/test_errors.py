"""One fault, from the reader of a file to the answer over HTTP and the exception of the client."""

from __future__ import annotations

import subprocess
import sys

import pytest
from pydantic import ValidationError

from biresnerf.client import ServiceError
from biresnerf.errors import Fault, FaultError, InputError
from biresnerf.wire.problems import JobError
from service.http.problems import problem_of
from workers.settings.errors import Conflict, NotFound, SetupError

FAULT = Fault(code="mask_unusable", detail="The mask is too small.", where="masks/1.png", hint="Scale it.")


def test_a_fault_keeps_every_field_from_the_reader_over_http_to_the_client() -> None:
    raised = InputError.of(FAULT)
    answer = problem_of(raised).problem().model_dump_json(exclude_none=True).encode()
    assert ServiceError.of_answer(422, {}, answer).fault == FAULT


def test_a_fault_keeps_every_field_through_the_report_of_a_job() -> None:
    error = JobError(**Fault.model_validate_json(InputError.of(FAULT).fault.model_dump_json()).model_dump())
    assert ServiceError.of(error, status=422).fault == FAULT


def test_an_error_reads_as_where_what_and_how_to_fix_it() -> None:
    assert str(InputError.of(FAULT)) == "masks/1.png: The mask is too small. Scale it."
    assert str(NotFound("No such job.")) == "No such job."


def test_what_others_say_of_a_fault_replaces_its_own_words() -> None:
    assert InputError.of(FAULT, hint="Leave it out.").fault == FAULT.model_copy(
        update={"hint": "Leave it out."}
    )


def test_a_fault_cannot_be_changed() -> None:
    with pytest.raises(ValidationError):
        FAULT.code = "other"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("error", "code", "status"),
    [
        (InputError("poses_missing", "None."), "poses_missing", 422),  # the library's own codes: the content
        (Conflict("state_conflict", "Over."), "state_conflict", 409),
        (NotFound("No such job."), "not_found", 404),
        (SetupError("no_postgres", "Install it."), "internal_error", 500),  # not the client's to fix
    ],
)
def test_the_status_of_an_answer_follows_the_code(error: FaultError, code: str, status: int) -> None:
    problem = problem_of(error)
    assert (problem.code, problem.status) == (code, status)


def test_the_errors_load_neither_numpy_nor_torch() -> None:
    loaded = "import biresnerf.errors, sys; print({'numpy', 'torch'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"

"""Every command that the pages show is run for real, on small sets; what cannot run here is at least well-formed."""

from __future__ import annotations

import itertools
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.documented import PYTHON, Command, all_commands
from tests.docs.forms_of_commands import check_shell, command_context, words_of
from tests.docs.workplace import SETS, Workplace, done_job, furnish, make_result
from tests.service.conftest import running_service, short_folder

pytestmark = pytest.mark.server

COMMANDS = all_commands()
# Beginnings of commands that are not run here, and why. Their form is checked all the same.
NOT_RUN = {
    "make ": "develops the project: tests, measurements, tools; CI runs lint, test and demo",
    "git clone": "an address that stands for the project's own",
    ". .venv/bin/activate": "the environment that `make setup` makes",
    "python3 -m venv": "an environment of its own; CI makes one",
    "pip install": "changes the environment; CI installs from scratch",
    "docker ": "needs Docker: tests/deploy/compose_check.sh runs the file with podman, as root",
    "TLS_CERTIFICATE=": "needs Docker and a certificate",
    "kubectl ": "needs a cluster; tests/deploy renders the manifests and runs their processes",
    "sh deploy/prepare.sh": "tests/deploy writes secrets where the file stands",
    "python -m pytest": "CI runs all tests",
    "python deploy/slurm": "needs Slurm; tests/deploy/test_slurm.py runs it on one",
    "python -m benchmarks": "takes minutes to hours; the figures stand beside the command",
    "biresnerf compare ": "takes hours; tests/studies/commands/test_compare.py runs a small one",
    "biresnerf study": "takes hours; tests/studies/commands/test_compare.py runs a small one",
    "biresnerf up": "the service that all other commands here ask is it, on a free port",
    "biresnerf submit photos --deliver": "needs a bucket; tests/service/client/test_addresses.py has one",
    "biresnerf submit s3://": "needs a bucket; tests/service/client/test_addresses.py has one",
    "biresnerf restore": "wants an empty installation; tests/workers/upkeep/test_backup.py restores one",
    "biresnerf refine fern_without_poses": "photos from nearly one place, as tests/refinement/start has some",
    "biresnerf export OUT kitti --poses-of body": "needs a flange's poses: tests/workers/jobs/test_derived_jobs.py",
    "ns-train ": "nerfstudio is not installed",
    "import json, smtplib\n": "serves until it is stopped; test_mail_receiver.py sends it events",
    "cp OUT/points.ply ": "after so few steps nothing in the field is solid, so there are no points",
    "./instant-ngp ": "instant-ngp is not installed",
    "python gsplat/": "gsplat is not installed",
    "python gaussian-splatting/": "3D Gaussian Splatting is not installed",
    "BIRESNERF_DATABASE_URL_FILE=": "settings, no command",
    "BIRESNERF_STORAGE_ENDPOINT=": "settings, no command",
}
# Python that is part of a program of the reader's, and what it needs to run.
FRAGMENTS = {
    "world_from_cam[17]": "import numpy\nworld_from_cam = numpy.tile(numpy.eye(4), (20, 1, 1))\n",
    "from standardwebhooks": (
        "import datetime, standardwebhooks\nsecret = 'whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw'\n"
        "now, body = datetime.datetime.now(datetime.timezone.utc), '{}'\n"
        "signature = standardwebhooks.Webhook(secret).sign('msg_1', now, body)\n"
        "headers = {'webhook-id': 'msg_1', 'webhook-signature': signature}\n"
        "headers['webhook-timestamp'] = str(int(now.timestamp()))\n"
    ),
}


def why_not_run(command: Command) -> str | None:
    return next((why for start, why in NOT_RUN.items() if command.text.startswith(start)), None)


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.language != PYTHON], ids=str)
def test_a_documented_command_could_be_run_as_it_is_written(command, tmp_path):
    check_shell(command.text.replace("/backups/biresnerf", str(tmp_path)))


@pytest.mark.parametrize("page", dict.fromkeys(command.page for command in COMMANDS))
def test_a_page_can_be_followed_from_its_top(page):
    """Nothing is used before the page says what it is, and no result goes where an earlier one lies."""
    taken, said = set(), False
    for command in (c for c in COMMANDS if c.page == page):
        said = said or command.text.startswith("api=")
        assert said or "$api" not in command.text, f"what is $api in {command}?"
        for output in outputs_of(command):
            assert output.isupper() or output not in taken, f"{command} writes to {output}, as one before"
            taken.add(output)  # in capitals it stands for a name of the reader's


def outputs_of(command: Command) -> list[str]:
    if command.language == PYTHON:
        return [name for name in re.findall(r'Path\("(\w+)"\)', command.text) if name not in SETS]
    _, words = words_of(command.text)
    if words[:1] != ["biresnerf"] or words[1] == "restore":
        return []
    output = command_context(words[1:]).params.get("output")
    return [str(output)] if output is not None else []


def test_no_exemption_is_stale():
    for start in NOT_RUN:
        assert any(command.text.startswith(start) for command in COMMANDS), f"no page has `{start}` any more"
    for start in FRAGMENTS:
        assert any(command.text.startswith(start) for command in COMMANDS), f"no page has `{start}` any more"


def test_most_commands_that_users_give_are_run():
    users = [c for c in COMMANDS if c.text.startswith(("biresnerf", "curl")) or c.language == PYTHON]
    run = [command for command in users if why_not_run(command) is None]
    assert len(run) > 0.6 * len(users)
    assert len(run) > 30


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = furnish(tmp_path_factory.mktemp("documented"))
    make_result(folder)
    return folder


@pytest.fixture(scope="module")
def workplaces(furnished: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[object]:
    """Makes a new workplace for a page, all with one service."""
    program = Path(__file__).with_name("small_job.py")
    with (
        short_folder() as folder,
        running_service(folder, auth="off", job_command=(sys.executable, str(program))) as service,
    ):
        job = done_job(service, furnished / "photos")

        def make() -> Workplace:
            folder = tmp_path_factory.mktemp("page")
            shutil.copytree(furnished, folder, symlinks=True, dirs_exist_ok=True)
            return Workplace(folder, service, job)

        yield make


def to_run() -> list[Command]:
    """What is run: each script once, though several pages name it."""
    scripts: set[str] = set()
    found = []
    for command in COMMANDS:
        again = command.text in scripts
        if command.text.startswith("python "):
            scripts.add(command.text)
        if why_not_run(command) is None and not again:
            found.append(command)
    return found


RUN = to_run()


@pytest.mark.parametrize("page", dict.fromkeys(command.page for command in RUN))
def test_the_commands_of_a_page_run_in_their_order(page, workplaces):
    workplace: Workplace = workplaces()
    try:
        for command in RUN:
            if command.page == page:
                run_one(workplace, command)
    finally:
        workplace.clear_the_queue()


def run_one(workplace: Workplace, command: Command) -> None:
    if command.language != PYTHON:
        workplace.run(command.text)
        return
    starts = (text for start, text in FRAGMENTS.items() if command.text.startswith(start))
    before = next(itertools.chain(starts, [""]))
    workplace.run_python(before + command.text)

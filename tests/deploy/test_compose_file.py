"""What compose.yaml promises, read from the file; `make compose-check` runs it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from tests.docs.forms_of_commands import command_context
from workers.settings.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]


def variables_of_the_files() -> set[str]:
    named = {name for service in SERVICES.values() for name in service.get("environment", {})}
    named |= set(re.findall(r"\b(BIRESNERF_[A-Z_]+)=", (ROOT / "Dockerfile").read_text()))
    return {name for name in named if name.startswith("BIRESNERF_")}


@pytest.mark.parametrize("variable", sorted(variables_of_the_files()))
def test_every_variable_is_a_setting_of_the_service(variable):
    # An unknown one would be ignored without a word.
    name = variable.removeprefix("BIRESNERF_").removesuffix("_FILE").lower()
    assert name in Settings.model_fields


def test_only_the_proxy_is_published():
    assert [name for name, service in SERVICES.items() if "ports" in service] == ["proxy"]


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_every_service_is_held_in(name):
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["init"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert {"memory", "pids"} <= set(service["deploy"]["resources"]["limits"])


@pytest.mark.parametrize("name", ["backup", "postgres", "store", "migrate", "worker", "worker-gpu"])
def test_what_serves_no_stranger_reaches_no_stranger(name):
    assert SERVICES[name]["networks"] == ["back"]
    assert COMPOSE["networks"]["back"] == {"internal": True}


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_secrets_come_as_files_that_prepare_makes(name):
    made = set(re.findall(r"^secret (\w+)", (ROOT / "deploy/prepare.sh").read_text(), flags=re.M))
    for secret in SERVICES[name].get("secrets", []):
        assert secret in made
        assert COMPOSE["secrets"][secret] == {"file": f"./secrets/{secret}"}
    for variable in SERVICES[name].get("environment", {}):
        assert not re.search(r"(PASSWORD|SECRET|TOKEN|KEY|DATABASE_URL)", variable) or variable.endswith(
            "_FILE"
        )


def test_backups_have_a_volume_that_the_image_s_user_owns_and_nothing_else_starts():
    """A volume without files gets the owner that the image gives the folder."""
    backup = SERVICES["backup"]
    (volume,) = backup["volumes"]
    named, folder = re.fullmatch(r"\$\{BIRESNERF_BACKUPS:-(\w+)\}:(/\w+)", volume).groups()
    assert named in COMPOSE["volumes"]
    assert re.search(rf"install -d -o biresnerf .* {folder}( |$)", (ROOT / "Dockerfile").read_text(), re.M)
    context = command_context(backup["command"][1:])
    assert (context.info_name, context.params["folder"].parent) == ("backup", Path(folder))
    # It is run, never started beside the service; and a database is restored into before it is migrated.
    assert backup["profiles"] == ["backup"]
    assert "depends_on" not in backup
    assert backup["environment"] == SERVICES["worker"]["environment"]


def test_workers_alone_have_less_than_the_usual_weight():
    assert {name for name, service in SERVICES.items() if service.get("cpu_shares", 1024) < 1024} == {
        "worker",
        "worker-gpu",
    }
    assert all(service.get("cpu_shares", 0) <= 1024 for service in SERVICES.values())


@pytest.mark.parametrize("name", ["worker", "worker-gpu"])
def test_a_worker_may_take_the_time_that_its_job_takes_to_stop(name):
    grace_s = float(SERVICES[name]["stop_grace_period"].removesuffix("s"))
    assert grace_s > 2 * Settings.model_fields["stop_grace_s"].default

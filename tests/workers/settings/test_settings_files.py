"""Secrets come from files, and errors name the variable."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from pydantic import ValidationError

from workers.settings.errors import SetupError
from workers.settings.settings import Settings
from workers.settings.settings_files import environment_with

URL = "postgresql://someone:pass%20word@db/jobs"


@pytest.fixture(autouse=True)
def _no_settings_of_ours(monkeypatch):
    for name in os.environ:
        if name.startswith("BIRESNERF_"):
            monkeypatch.delenv(name)


def named(monkeypatch, variable, path, content):
    path.write_bytes(content)
    monkeypatch.setenv(variable, str(path))


@pytest.mark.parametrize("ending", [b"", b"\n", b"\r\n"])
def test_a_secret_in_a_file_is_the_setting(monkeypatch, tmp_path, ending):
    named(monkeypatch, "BIRESNERF_DATABASE_URL_FILE", tmp_path / "url", URL.encode() + ending)
    assert Settings().database_url == URL


def test_numbers_and_lists_come_from_files_too(monkeypatch, tmp_path):
    named(monkeypatch, "BIRESNERF_SLOTS_FILE", tmp_path / "slots", b"3\n")
    command = ["python", "-m", "workers.run.job_process"]
    named(monkeypatch, "BIRESNERF_JOB_COMMAND_FILE", tmp_path / "command", json.dumps(command).encode())
    settings = Settings()
    assert (settings.slots, list(settings.job_command)) == (3, command)


def test_what_code_gives_outweighs_the_file(monkeypatch, tmp_path):
    named(monkeypatch, "BIRESNERF_DATABASE_URL_FILE", tmp_path / "url", URL.encode())
    assert Settings(database_url="postgresql:///other").database_url == "postgresql:///other"


def test_a_setting_and_its_file_together_are_refused(monkeypatch, tmp_path):
    named(monkeypatch, "BIRESNERF_DATABASE_URL_FILE", tmp_path / "url", URL.encode())
    monkeypatch.setenv("BIRESNERF_DATABASE_URL", URL)
    with pytest.raises(SetupError, match="BIRESNERF_DATABASE_URL_FILE") as raised:
        Settings()
    assert raised.value.code == "setting_given_twice"


@pytest.mark.parametrize(
    ("content", "code"),
    [(None, "setting_file_unreadable"), (b"\xff", "setting_file_unreadable"), (b"\n", "setting_file_empty")],
)
def test_a_file_that_gives_nothing_is_refused_by_name(monkeypatch, tmp_path, content, code):
    path = tmp_path / "url"
    monkeypatch.setenv("BIRESNERF_DATABASE_URL_FILE", str(path))
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SetupError, match="BIRESNERF_DATABASE_URL_FILE") as raised:
        Settings()
    assert raised.value.code == code


def test_a_value_in_a_file_is_held_to_the_settings_bounds(monkeypatch, tmp_path):
    named(monkeypatch, "BIRESNERF_SLOTS_FILE", tmp_path / "slots", b"-1")
    with pytest.raises(ValidationError, match="slots"):
        Settings()


def test_a_child_that_is_given_a_setting_is_not_given_its_file_too(monkeypatch, tmp_path):
    named(monkeypatch, "BIRESNERF_DATABASE_URL_FILE", tmp_path / "url", b"postgresql:///from-file")
    named(monkeypatch, "BIRESNERF_SLOTS_FILE", tmp_path / "slots", b"3")
    for_child = environment_with({"BIRESNERF_DATABASE_URL": URL})
    for name in set(os.environ) - set(for_child):
        monkeypatch.delenv(name)
    monkeypatch.setenv("BIRESNERF_DATABASE_URL", for_child["BIRESNERF_DATABASE_URL"])
    assert (Settings().database_url, Settings().slots) == (URL, 3)


def test_a_command_tells_the_operator_what_to_change(tmp_path):
    missing = tmp_path / "missing"
    environment = {**os.environ, "BIRESNERF_DATABASE_URL_FILE": str(missing)}
    outcome = subprocess.run(
        [sys.executable, "-m", "biresnerf.command_line", "migrate"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert outcome.returncode == 2
    assert "BIRESNERF_DATABASE_URL_FILE" in outcome.stderr
    assert "Traceback" not in outcome.stderr

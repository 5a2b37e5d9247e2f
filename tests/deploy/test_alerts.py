"""The alerts: Prometheus' own tool runs their tests, and the operator finds each in the docs."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "deploy" / "prometheus"
RULES = [
    rule
    for group in yaml.safe_load((FOLDER / "alerts.yaml").read_text())["groups"]
    for rule in group["rules"]
]
TESTS = yaml.safe_load((FOLDER / "alerts_test.yaml").read_text())["tests"]


def test_prometheus_fires_each_alert_where_it_should():
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed (Debian's package prometheus has it)")
    for command in (["check", "rules", "alerts.yaml"], ["test", "rules", "alerts_test.yaml"]):
        ran = subprocess.run([promtool, *command], cwd=FOLDER, capture_output=True, text=True, timeout=60)
        assert ran.returncode == 0, ran.stdout + ran.stderr


def test_every_alert_is_tested_to_fire_and_not_to():
    fires: dict[str, set[bool]] = {}
    for test in TESTS:
        for case in test["alert_rule_test"]:
            fires.setdefault(case["alertname"], set()).add(bool(case["exp_alerts"]))
    assert fires == {rule["alert"]: {True, False} for rule in RULES}


def test_the_docs_say_what_to_do_about_each_alert():
    page = (ROOT / "docs" / "operations.md").read_text()
    _, _, section = page.partition("### Alerts\n")
    told = re.findall(r"^\*\*(Biresnerf\w+)\*\*", section, re.M)
    assert told == [rule["alert"] for rule in RULES]

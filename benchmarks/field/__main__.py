"""`make field-check`: the product on sets as their owners published them; ``python -m benchmarks.field [SET...]``.

BIRESNERF_FIELD_DATA is the folder of clones and results; missing clones are fetched from GitHub. Each set
goes through COLMAP with its own defaults, then through `refine` as photos alone and with noisy poses, and with --url
through a service. Prints a JSON line for each set, then a table of all sets that were ever run in that folder.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from benchmarks.field.run_set import RUNS, Asked, run_set
from benchmarks.field.sets import read_sets
from benchmarks.field.table import table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", help="By name. Default: all that are not held back.")
    parser.add_argument("--held-back", action="store_true", help="Those held back, in place of the others.")
    parser.add_argument("--photos", type=int, help="Of a set, at most: its first ones.")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--runs", default=",".join(RUNS), help="Which, with commas. Default: %(default)s.")
    parser.add_argument("--url", help="A service that gets each set as well.")
    parser.add_argument(
        "--keep", action="store_true", help="Do not repeat runs of the product that are done."
    )
    parser.add_argument("--table", action="store_true", help="Only print the table.")
    options = parser.parse_args()
    if not (data := os.environ.get("BIRESNERF_FIELD_DATA")):
        raise SystemExit("Set BIRESNERF_FIELD_DATA to the folder of clones; what it lacks is cloned into it.")
    listed = read_sets()
    if unknown := set(options.sets) - {each.name for each in listed}:
        raise SystemExit(f"No such sets: {', '.join(sorted(unknown))}.")
    rows = Path(data) / "rows"
    rows.mkdir(parents=True, exist_ok=True)
    settings = [part for setting in options.set for part in ("--set", setting)]
    product, runs = ("--preset", options.preset, *settings), tuple(options.runs.split(","))
    asked = Asked(Path(data), options.photos, product, options.url, runs, options.keep)
    chosen = [each for each in listed if each.name in options.sets] if options.sets else [
        each for each in listed if each.held_back == options.held_back
    ]  # fmt: skip
    for each in [] if options.table else chosen:
        row = run_set(each, asked)
        (rows / f"{each.name}.json").write_text(json.dumps(row, indent=1), "utf-8")
        print(json.dumps(row), flush=True)
    found = [rows / f"{each.name}.json" for each in listed]
    print(table([json.loads(path.read_text("utf-8")) for path in found if path.is_file()]))


if __name__ == "__main__":
    main()

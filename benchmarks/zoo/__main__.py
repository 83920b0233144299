"""Solve the zoo anew: ``python -m benchmarks.zoo [NAME ...] [--grids K] [--no-pictures]``.

Writes ``tests/whole/zoo.json``, the tables of ``docs/zoo.md`` and ``docs/images/zoo/``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time

import lmdsl as lm
from benchmarks import zoo
from benchmarks.zoo import page, pictures


def main() -> int:
    """Measure what was asked for, and write it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.zoo", description=__doc__)
    parser.add_argument("names", nargs="*", help="of systems; all if none is given")
    parser.add_argument("--grids", type=int, default=3, help="how many, coarsest first (3)")
    parser.add_argument("--no-pictures", action="store_true")
    options = parser.parse_args()
    known = zoo.entries()
    unknown = [name for name in options.names if name not in known]
    if unknown:
        print(f"there is no {unknown[0]}; there are {', '.join(known)}", file=sys.stderr)
        return 2
    for name in options.names or known:
        for grid in known[name]["grids"][: options.grids]:
            started = time.perf_counter()
            lp = lm.compile(zoo.problem(known[name], grid["cells"]))
            grid.update(zoo.measured(lp))
            print(f"{name} {page.row(grid)} {time.perf_counter() - started:.1f} s", flush=True)
        if not options.no_pictures:
            size = pictures.draw(name, known[name])
            print(f"{name}: picture of {size // 1000} kB", flush=True)
        zoo.GOLDEN.write_text(json.dumps(known, indent=1) + "\n")
    page.PAGE.write_text(page.filled(page.PAGE.read_text(), known))
    return 0


if __name__ == "__main__":
    sys.exit(main())

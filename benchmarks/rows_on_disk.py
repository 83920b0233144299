"""What rows on disk cost: ``python -m benchmarks.rows_on_disk --cells 1000 --folder DIR``.

The standard map, solved in memory and with rows on disk, each in a process of its own: once as the
system keeps what was read, and once with all rows evicted before every pass, which is what it costs
where nothing of them finds a place in memory. One JSON object a run; the bits must be the same.
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import models

PAGE_OUT = 21  # of Linux: write pages to their file, and take them from memory


def main() -> int:
    """Measure in processes of their own, or what is asked of this one."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rows_on_disk")
    parser.add_argument("--cells", type=int, default=1000, help="cells an axis (default 1000)")
    parser.add_argument("--folder", type=Path, required=True, help="where rows lie")
    parser.add_argument("--run", choices=("memory", "disk", "evicted"), help="in this process")
    options = parser.parse_args()
    if options.run is not None:
        print(json.dumps(measured(options.cells, options.folder, options.run)))
        return 0
    digests = set()
    for run in ("memory", "disk", "evicted"):
        asked = ["--cells", str(options.cells), "--folder", str(options.folder), "--run", run]
        command = [sys.executable, "-m", "benchmarks.rows_on_disk", *asked]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        print(said, end="", flush=True)
        digests.add(json.loads(said)["answer"])
    return int(len(digests) > 1)


def problem(cells: int) -> Any:
    """Return the standard map on so many cells an axis."""
    return models.problem(
        "standard_map", {"x": cells, "y": cells}, 21, {"kind": "random", "points": 10, "seed": 0},
        gamma=1.02,
    )  # fmt: skip


def measured(cells: int, folder: Path, run: str) -> dict[str, Any]:
    """Solve once; return seconds, memory, and what must be the same."""
    import lmdsl as lm

    lm.solve(problem(20))  # kernels are compiled by now
    if run == "evicted":
        evict_before_passes()
    started, spent = time.perf_counter(), time.process_time()
    found = lm.solve(problem(cells), rows_on_disk=None if run == "memory" else folder)
    return {
        "run": run, "cells": cells, "status": found.status.value,
        "wall": round(time.perf_counter() - started, 3),
        "processor": round(time.process_time() - spent, 3),
        "seconds": {name: round(value or 0.0, 3) for name, value in vars(found.seconds).items()},
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "answer": f"{found.lp and found.lp.digest} {float(found.cost or 0).hex()}",
    }  # fmt: skip


def evict_before_passes() -> None:
    """Take all rows from memory whenever policies are improved or claims of all pairs judged."""
    from lmdsl.certificate import bounds
    from lmdsl.common.on_disk import _Mapping
    from lmdsl.optimize.policies.screening import Screen

    def before(work: Any) -> Any:
        def evicting(*arguments: Any, **named: Any) -> Any:
            for each in gc.get_objects():
                if isinstance(each, _Mapping):
                    each.flush()
                    each.madvise(PAGE_OUT)
            return work(*arguments, **named)

        return evicting

    Screen.improve = before(Screen.improve)  # type: ignore[method-assign]
    bounds.holds_for_all = before(bounds.holds_for_all)


if __name__ == "__main__":
    sys.exit(main())

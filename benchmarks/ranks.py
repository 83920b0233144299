"""What a problem takes over ranks, beside what one process takes: ratios in one run.

Every row is the standard map, solved in fresh processes with one thread each: by the code of one
process, and over ranks under MPI, by turns. Of several runs the least counts, as others on the
machine only add; of several ranks the one that takes most, or, of processor time, their sum.

What processors that share caches and memory take from each other is not the library's: two
processes that know nothing of each other run side by side, too, and say how much that is.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.over_ranks import STAGES
from benchmarks.process import MARK, ROOT, Failed, ended, environment
from benchmarks.run import Run

SIZES, QUICK = (500, 1000), (200,)  # cells an axis
COUNTS = (2, 4, 8)
MEMORY, PROCESSOR = 1.15, 1.15  # of an equal share; of one process
WALL = {"compile": 0.6, "solve": 0.65, "verify": 0.65}
BYTES = {2: 200, 8: 350}  # an own cell
CALLS = 700  # of a solve
BESIDE = -2  # stands for two processes side by side that are no ranks
NAMES = {0: "one process", BESIDE: "two processes side by side"}
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

Report = dict[str, Any]  # of one rank


def measure(run: Run, sizes: Iterable[int], counts: Iterable[int], everybody: bool) -> None:
    """Measure the goals at these sizes, and numbers of ranks."""
    mode, counts = "all" if everybody else "first", sorted({*counts})
    why = _missing()
    if why:
        run.targets.append(_row("over ranks", "measured", f"skipped: {why}", None))
        run.log(f"over ranks: skipped: {why}")
        return
    for cells in sizes:
        for row in _of_size(run, cells, counts, mode):
            run.targets.append(row)
            run.log(f"{row['target']}: {row['measured']} (goal {row['goal']})")
            run.save()


def agree(run: Run, dozen: bool) -> None:
    """Ask whether all shipped systems and 50 random problems are answered as in one process.

    Over 1, 2, 3, 4 and 7 ranks as threads, and 2 and 4 processes where there is an MPI.
    """
    helper = ROOT / "tests" / "helpers" / "matrix.py"
    command = [sys.executable, str(helper), *(["--dozen"] if dozen else [])]
    command += [] if _missing() else ["--mpi", "2,4"]
    done = subprocess.run(
        command,
        env=environment(**ONE_THREAD),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    for line in done.stdout.splitlines():
        run.log(line)
    last = (done.stdout.splitlines() or [done.stderr[-300:]])[-1]
    how = "1, 2, 3, 4, 7 ranks" + ("" if _missing() else ", 2 and 4 processes")
    run.targets.append(_row(f"as in one process: {how}", "all", last, done.returncode == 0))
    run.save()


def _of_size(run: Run, cells: int, counts: list[int], mode: str) -> Iterator[dict[str, Any]]:
    beside: dict[int, list[list[Report]]] = {BESIDE: []} if 2 in counts else {}
    found = {0: [], **beside, **{count: [] for count in counts}}
    name = f"standard map, {cells} x {cells}"
    for _ in range(run.rules.repeats):  # by turns, so that noise hits all alike
        for count, reports in found.items():
            run.log(f"{name}: {NAMES.get(count, f'{count} ranks')}")
            try:
                reports.append(launched(count, cells, mode, run.rules.limit))
            except Failed as error:
                what = NAMES.get(count, f"{count} ranks")
                yield _row(f"{name}, {what}", "measured", f"failed: {error}", None)
                return
    one, two = found.pop(0), found.pop(BESIDE, [])
    run.over_ranks.append(
        {"cells": cells, "mode": mode, "one": one, "side by side": two, "ranks": found}
    )
    for stage in STAGES if two else ():
        ratio = _taken(two, stage, "cpu", sum) / 2 / _taken(one, stage, "cpu", sum)
        yield _row(f"{name}: processor time of {stage}, one of two side by side / one alone",
                   "what the machine adds", f"{ratio:.3g}", None)  # fmt: skip
    for count, reports in found.items():
        yield from rows(f"{name}, {count} ranks", count, one, reports)


def rows(
    name: str, count: int, one: list[list[Report]], many: list[list[Report]]
) -> Iterator[dict[str, Any]]:
    """Yield the goals of a number of ranks, with what was measured; each list is of runs."""
    alike = all(
        own["status"] == one[0][0]["status"] and sum(each["cells"] for each in reports)
        == sum(each["cells"] for each in one[0]) for reports in many for own in reports
    )  # fmt: skip
    yield _row(f"{name}: same status and cells", "yes", "yes" if alike else "no", alike)
    own = [
        _least(max(rank["peak"] for rank in reports) for reports in runs) for runs in (one, many)
    ]
    yield _most(f"{name}: memory of a rank / one process", MEMORY / count, own[1] / own[0])
    for stage in STAGES if count == 2 else ():
        yield _most(f"{name}: processor time of {stage} / one process", PROCESSOR,
                    _taken(many, stage, "cpu", sum) / _taken(one, stage, "cpu", sum))  # fmt: skip
    for stage in STAGES if count == 2 else ():
        yield _most(f"{name}: time of {stage} / one process", WALL[stage],
                    _taken(many, stage, "wall", max) / _taken(one, stage, "wall", max))  # fmt: skip
    sent = max(
        sum(stage["sent"] for stage in rank["stages"].values()) / max(rank["cells"], 1)
        for rank in many[0]
    )
    total = sum(stage["sent"] for rank in many[0] for stage in rank["stages"].values())
    mean = total / max(sum(rank["cells"] for rank in many[0]), 1)
    goal = BYTES.get(count)
    text = f"{mean:.0f} (the most of a rank {sent:.0f})"
    yield _row(f"{name}: bytes sent an own cell", f"at most {goal}" if goal else "", text,
               mean <= goal if goal else None)  # fmt: skip
    calls = sum(many[0][0]["stages"][stage]["calls"] for stage in STAGES)
    yield _row(f"{name}: collective calls", f"at most {CALLS}", f"{calls:.0f}", calls <= CALLS)


def _taken(runs: list[list[Report]], stage: str, what: str, joined: Any) -> float:
    """Return the least of all runs of what the ranks took together."""
    return _least(joined(rank["stages"][stage][what] for rank in reports) for reports in runs)


def _least(values: Iterable[float]) -> float:
    return max(min(values), 1e-9)


def _most(target: str, goal: float, ratio: float) -> dict[str, Any]:
    return _row(target, f"at most {goal:.3g}", f"{ratio:.3g}", ratio <= goal)


def _row(target: str, goal: str, measured: str, met: bool | None) -> dict[str, Any]:
    return {"target": target, "goal": goal, "measured": measured, "met": met}


def _launcher() -> str | None:
    """Return the launcher of this environment, or the machine's."""
    return shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or shutil.which("mpiexec")


def _missing() -> str:
    """Return what is missing to start ranks, nothing if they can be started."""
    if importlib.util.find_spec("mpi4py") is None:
        return "mpi4py is not installed; pip install 'lmdsl[mpi]'"
    return "" if _launcher() else "no mpiexec is found; pip install mpich"


def launched(count: int, cells: int, mode: str, limit: float) -> list[Report]:
    """Return what every rank reports, of no ranks what one process does, or two side by side.

    Raises
    ------
    Failed
        With the last line that was written, or the limit.
    """
    if count == BESIDE:
        with ThreadPoolExecutor(2) as pool:
            both = pool.map(lambda _: launched(0, cells, mode, limit), range(2))
            return [report for reports in both for report in reports]
    mode = mode if count else "alone"
    command = [sys.executable, "-m", "benchmarks.over_ranks", str(cells), mode]
    launcher = _launcher()
    if count and launcher:
        command = [launcher, "-n", str(count), *command]
    found: list[Report] = reported(command, limit)
    return found


def reported(command: list[str], limit: float) -> Any:
    """Return what a command of one thread a process reports in a line of its own.

    Raises
    ------
    Failed
        With the last line that was written, or the limit.
    """
    try:
        done = subprocess.run(
            command, env=environment(**ONE_THREAD), cwd=ROOT, capture_output=True, text=True,
            timeout=limit, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise Failed(f"> {limit:g} s") from None
    for line in done.stdout.splitlines():
        if line.startswith(MARK):
            return json.loads(line.removeprefix(MARK))
    last = [line for line in done.stderr.splitlines() if line.strip()]
    raise Failed(last[-1][:300] if last else ended(done.returncode))

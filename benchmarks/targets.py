"""The targets of the project, each with what was measured and whether it is met."""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.process import ROOT, environment
from benchmarks.report import memory, seconds
from benchmarks.rivals import storm
from benchmarks.run import DISCOUNT, Run

SIZES = (70, 224, 707, 1000, 2236, 3162)
"""Cells an axis of the standard map: 1e5 to 2e8 pairs."""


def measure(run: Run, largest: int) -> None:
    """Measure every target that needs no more cells an axis than ``largest``."""
    for one in _all(run, largest):
        run.targets.append(one)
        run.log(f"{one['target']}: {one['measured']} (goal {one['goal']})")
        run.save()


def _all(run: Run, largest: int) -> Iterator[dict[str, Any]]:
    yield from _rivals(run)
    yield from _stages(run, largest)
    yield from _sizes(run, largest)
    yield from _small(run)
    yield from _slow(run)
    yield from _far(run)
    yield from _lossless(run)


def _target(target: str, goal: str, measured: str, met: bool | None) -> dict[str, Any]:
    return {"target": target, "goal": goal, "measured": measured, "met": met}


def _unmeasured(target: str, goal: str, why: str) -> dict[str, Any]:
    return _target(target, goal, f"not measured: {why}", None)


def _rivals(run: Run) -> Iterator[dict[str, Any]]:
    sound = tuple(f"Storm {words}" for words in storm.SOUND.values())
    mpi = "QuantEcon modified policy iteration"
    for target, model, gamma, words, names, goal in (
        ("Storm's best sound method", "standard-map-200", 1.0, "Storm", sound, 20),
        (mpi, "standard-map-200", DISCOUNT, mpi, (mpi,), 10),
        ("HiGHS IPX without crossover", "standard-map-100", 1.02, "IPX", ("HiGHS IPX",), 400),
    ):
        rows = run.group(model, gamma, run.among(words))
        known = [row for row in rows if row["contestant"] in names and row["ratio"] is not None]
        label, aim = f"times faster than {target}, {model}", f"at least {goal}"
        if not known:
            why = "; ".join(sorted({row["status"] for row in rows if row["contestant"] in names}))
            yield _unmeasured(label, aim, why or "not in this run")
            continue
        best = min(known, key=lambda row: row["median"])
        text = f"{best['ratio']:.3g} ({best['contestant']}, {seconds(best['median'])})"
        yield _target(label, aim, text, best["ratio"] >= goal)


def _stages(run: Run, largest: int) -> Iterator[dict[str, Any]]:
    names = [f"standard-map-{cells}" for cells in (200, 1000) if cells <= largest]
    for name in names:
        found = run.stages(name)
        rows = {row["what"]: row for row in found.get("rows", ()) if "seconds" in row}
        for what in ("as written", "each sine once"):
            label = f"compile, of the time of the formula {what}, {name}"
            formula, compiled = rows.get(f"formula with NumPy, {what}"), rows.get("compile")
            if formula is None or compiled is None:
                yield _unmeasured(label, "at most 0.5", found.get("failed", "missing"))
                continue
            ratio = compiled["seconds"] / formula["seconds"]
            text = f"{ratio:.3g} ({seconds(compiled['seconds'])})"
            yield _target(label, "at most 0.5", text, ratio <= 0.5)
        label, solve = f"solve, of one reading of the compact rows, {name}", rows.get("solve")
        if solve is None:
            yield _unmeasured(label, "at most 40", found.get("failed", "missing"))
        else:
            yield _target(label, "at most 40", f"{solve['ratio']:.3g}", solve["ratio"] <= 40)


def _sizes(run: Run, largest: int) -> Iterator[dict[str, Any]]:
    goals = {1000: (6.0, 2.5e9), 3162: (90.0, 12e9)}
    per_pair = {}
    for cells in (cells for cells in SIZES if cells <= largest):
        name = f"standard-map-{cells}"
        processes = run.rules.repeats if cells <= 1000 else 1
        found = run.pipeline(name, 1.02, processes=processes)
        if "failed" not in found:
            per_pair[cells] = statistics.median(found["seconds"]["total"]) / found["pairs"]
        if cells in goals:
            yield from _size(name, found, *goals[cells])
    label = "cost per pair, largest over least, standard map of 1e5 to 2e8 pairs"
    if len(per_pair) < 2:
        yield _unmeasured(label, "at most 2", f"--largest {largest}")
        return
    ratio = max(per_pair.values()) / min(per_pair.values())
    spread = ", ".join(f"{cells}: {1e9 * cost:.0f} ns" for cells, cost in per_pair.items())
    complete = len(per_pair) == len(SIZES)
    met = ratio <= 2 if complete or ratio > 2 else None
    yield _target(label, "at most 2", f"{ratio:.3g} ({spread})", met)


def _size(
    name: str, found: dict[str, Any], time_goal: float, memory_goal: float
) -> Iterator[dict[str, Any]]:
    label = f"compile, solve and verify, {name}"
    goal = f"{time_goal:g} s, {memory(memory_goal)}"
    if "failed" in found:
        yield _target(label, goal, found["failed"], False)
        return
    total = statistics.median(found["seconds"]["total"])
    met = found["status"] == "verified" and total <= time_goal and found["peak"] <= memory_goal
    text = f"{seconds(total)}, {memory(found['peak'])}, {found['status']}"
    yield _target(label, goal, f"{text} ({len(found['seconds']['total'])} runs)", met)
    label = f"memory estimate of the measured peak, {name}"
    if not found["estimates"]:
        yield _unmeasured(label, "0.75 to 1.25", "lmdsl gave none")
        return
    # What the interpreter and the kernels take is there before any model.
    used = found["peak"] - found["base"]
    ratio = found["estimates"][-1] / used
    text = f"{ratio:.3g} ({memory(found['estimates'][-1])} of {memory(used)})"
    yield _target(label, "0.75 to 1.25", text, 0.75 <= ratio <= 1.25)


def _small(run: Run) -> Iterator[dict[str, Any]]:
    name = "standard-map-50"
    found = run.pipeline(name, 1.02, repeats=4 * run.rules.repeats)
    label = f"compile, solve and verify in a warm process, {name}"
    if "failed" in found:
        yield _unmeasured(label, "25 ms", found["failed"])
    else:
        total = statistics.median(found["seconds"]["total"])
        yield _target(label, "25 ms", seconds(total), total <= 0.025)
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        first = [_command(Path(folder) / f"cache{k}") for k in range(min(run.rules.repeats, 3))]
        again = [_command(Path(folder) / "cache0") for _ in range(run.rules.repeats)]
    label = "lmdsl solve examples/standard_map.json from process start"
    for what, times, goal in (("kernels cached", again, 1.5), ("first ever", first, 15.0)):
        if None in times:
            yield _unmeasured(f"{label}, {what}", f"{goal:g} s", "the command failed")
            continue
        median = statistics.median(times)  # type: ignore[type-var]
        text = f"{seconds(median)} ({len(times)} runs)"
        yield _target(f"{label}, {what}", f"{goal:g} s", text, median <= goal)


def _command(cache: Path) -> float | None:
    """Return the seconds of the command with a folder of compiled kernels, None if it fails."""
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as out:
        command = [sys.executable, "-m", "lmdsl", "solve", "examples/standard_map.json"]
        variables = environment(NUMBA_CACHE_DIR=str(cache))
        variables.pop("PYTHONDONTWRITEBYTECODE", None)  # where it is set, modules compile each time
        started = time.perf_counter()
        done = subprocess.run(
            [*command, "--out", f"{out}/result"],
            cwd=ROOT,
            env=variables,
            capture_output=True,
            check=False,
        )
        return time.perf_counter() - started if done.returncode == 0 else None


def _slow(run: Run) -> Iterator[dict[str, Any]]:
    label = "slow-pendulum-200, solve and verify per pair over standard-map-200"
    slow = run.pipeline("slow-pendulum-200", 1.0, processes=run.rules.repeats)
    quick = run.pipeline("standard-map-200", 1.0, processes=run.rules.repeats)
    if "failed" in slow or "failed" in quick:
        yield _unmeasured(label, "at most 3", slow.get("failed") or quick["failed"])
        return

    def ratio(*stages: str) -> float:
        cost = [
            sum(statistics.median(one["seconds"][stage]) for stage in stages) / one["pairs"]
            for one in (slow, quick)
        ]
        return cost[0] / cost[1]

    # Its compilation is another formula, four times a sample, at more samples: shown, not judged.
    parts = ", ".join(f"{stage} {ratio(stage):.3g}" for stage in ("solve", "verify", "compile"))
    judged = ratio("solve", "verify")
    yield _target(label, "at most 3", f"{judged:.3g} ({parts})", judged <= 3)


def _far(run: Run) -> Iterator[dict[str, Any]]:
    """Measure gamma far beyond gamma_bar: its refusal with the bracket, and the bracket alone."""
    repeats = run.rules.repeats
    for name in ("standard-map-200", "slow-pendulum-200"):
        near = run.pipeline(name, 1.0, processes=repeats)
        far, limit = run.pipeline(name, 5.0, processes=repeats), run.bracket(name, 0.01)
        for what, found in (("gamma = 5 refused", far), ("gamma_bar to 1 %", limit)):
            label = f"{what}, of solve and verify at gamma = 1, {name}"
            if "failed" in near or "failed" in found:
                yield _unmeasured(label, "at most 20", near.get("failed") or found["failed"])
                continue
            ratio = _after_compiling(found) / _after_compiling(near)
            yield _target(label, "at most 20", f"{ratio:.3g}", ratio <= 20)


def _after_compiling(found: dict[str, Any]) -> float:
    times = found["seconds"]
    return statistics.median(times["total"]) - statistics.median(times["compile"])


def _lossless(run: Run) -> Iterator[dict[str, Any]]:
    """Measure a problem whose runs end with probability 0.01 a step, and no other way."""
    name = "boost-converter-800"
    label, found = f"compile, solve and verify, {name}", run.pipeline(name, 1.0)
    if "failed" in found:
        yield _unmeasured(label, "8 s", found["failed"])
        return
    total = statistics.median(found["seconds"]["total"])
    text = f"{seconds(total)}, {found['status']}"
    yield _target(label, "8 s", text, found["status"] == "verified" and total <= 8)

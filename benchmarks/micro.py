"""Microbenchmarks of lmdsl's stages beside what the machine can do, measured in one process.

The limits: reading the compact rows once, reading V at random for every entry of them, and
evaluating the map's formula with NumPy at every (cell, control, sample) on full arrays.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import njit

import lmdsl as lm
from benchmarks import internals, models

SLAB = 2**23
"""Samples in one full array: far beyond any cache."""


def measure(name: str, repeats: int) -> dict[str, Any]:
    """Return the limits and the stages of a model, in seconds and nanoseconds per unit."""
    model = models.get(name)
    problem, lp = model.make(), model.compiled()
    result = lm.solve(lp)
    V = result.value[lp.cells]
    pair = internals.improvement_sweep(lp, V)().policy
    pointer, target, _ = internals.transitions(lp)
    entries = len(target)
    policy_entries = int((pointer[pair + 1] - pointer[pair]).sum())
    rows: list[dict[str, Any]] = []

    def note(what: str, run: Callable[[], Any], unit: str, count: int, limit: str = "") -> None:
        try:
            seconds = _median(run, repeats)
        except Exception as error:  # an internal that moved must not cost the rest
            rows.append({"what": what, "missing": f"{type(error).__name__}: {error}"})
            return
        found = {"what": what, "seconds": seconds, "unit": unit, "ns": 1e9 * seconds / count}
        base = next((row for row in rows if row["what"] == limit and "seconds" in row), None)
        if base is not None:
            found |= {"limit": limit, "ratio": seconds / base["seconds"]}
        rows.append(found)

    data = np.concatenate([array.view(np.uint8) for array in internals.compact(lp)])
    data = data[: len(data) // 16 * 16].view(np.uint64)
    padded = np.append(V, 0.0)
    note("read rows, 1 thread", lambda: _sum(data), "byte", data.nbytes)
    halves = np.array_split(data, 2)
    note("read rows, 2 threads", lambda: _by_two(_sum, halves), "byte", data.nbytes)
    note("read V at random", lambda: _gather(target, padded), "entry", entries)
    halves_of_targets = np.array_split(target, 2)
    note(
        "read V at random, 2 threads",  # two processors may be one core
        lambda: _by_two(lambda half: _gather(half, padded), halves_of_targets),
        "entry", entries, "read V at random",
    )  # fmt: skip
    if isinstance(problem, lm.Problem):
        samples, pilot = _samples(problem), None
        for what, formula in _formulas(problem).items():
            pilot = _on_full_arrays(problem, formula, repeats, samples)
            rows.append(
                {"what": what, "seconds": pilot, "unit": "sample", "ns": 1e9 * pilot / samples}
            )
        limit = rows[-1]["what"]
        note("compile", lambda: lm.compile(problem), "sample", samples, limit)
        if problem.judged == "path":
            system, at_ends = problem.system, "compile, judged at ends of steps"
            ends = problem.replaced(system=system.replaced(judged="endpoint"))
            note(at_ends, lambda: lm.compile(ends), "sample", samples)
            run = "compile, judged along paths"
            note(run, lambda: lm.compile(problem), "sample", samples, at_ends)
        if problem.noise is None:
            sure = problem.replaced(successors="enclosed")
            run = "compile, successors enclosed"
            note(run, lambda: lm.compile(sure), "sample", samples, "compile")
        if (function := _as_function(problem)) is not None:
            run = "compile, a Python function"
            note(run, lambda: lm.compile(function), "sample", samples, "compile")
    step = internals.improvement_sweep(lp, V)
    note("improvement sweep", step, "entry", entries, "read V at random")
    sweep = _made(internals.evaluation_sweep, lp, pair)
    note("evaluation sweep", sweep, "entry", policy_entries, "read rows, 1 thread")
    note("evaluation of a policy", internals.evaluation(lp, pair), "entry", policy_entries)
    proof = internals.certificate(lp, pair, V)
    note("certificate", proof, "pair", lp.K, "read rows, 2 threads")
    backend = lm.backends.get("policy-iteration")

    def solve() -> Any:
        return backend.solve(internals.cold(lp), lm.backends.Options())

    note("solve", solve, "pair", lp.K, "read rows, 2 threads")
    return {
        "model": name, "gamma": lp.gamma, "pairs": lp.K, "entries": entries,
        "rows_bytes": int(data.nbytes), "repeats": repeats, "rows": rows,
    }  # fmt: skip


def _made(make: Callable[..., Callable[[], Any]], *arguments: Any) -> Callable[[], Any]:
    """Make something to time; what goes wrong is raised when it is called."""
    try:
        return make(*arguments)
    except Exception as error:
        failed = error

        def fail() -> None:
            raise failed

        return fail


def _median(run: Callable[[], Any], repeats: int) -> float:
    run()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def _samples(problem: lm.Problem) -> int:
    """Return cells x controls x samples."""
    data = problem.to_dict()
    cells = np.prod([axis["cells"] for axis in data["state_box"].values()])
    controls = np.prod([grid["points"] for grid in data["control_grid"].values()])
    sampling = data["sampling"]
    points = sampling.get("points") or sampling["per_axis"] ** len(data["state_box"])
    return int(cells * controls * points)


def _formulas(problem: lm.Problem) -> dict[str, Callable[[dict[str, Any]], Any]]:
    """Return ways to evaluate the map; the last is the one assembly is held against."""
    if problem.to_dict()["system"]["kind"] == "standard_map":
        return {
            "formula with NumPy, each sine once": _standard_map_once,
            "formula with NumPy, as written": _standard_map,
        }
    return {"formula with NumPy": problem.step()}


def _standard_map(v: dict[str, Any]) -> Any:
    x, y, u, K = v["x"], v["y"], v["u"], 0.25
    return x + y + K * u * np.sin(2 * np.pi * x), y + K * u * np.sin(2 * np.pi * x)


def _standard_map_once(v: dict[str, Any]) -> Any:
    y = v["y"] + 0.25 * v["u"] * np.sin(2 * np.pi * v["x"])
    return v["x"] + y, y


def _as_function(problem: lm.Problem) -> lm.Problem | None:
    """Return the problem with its map as a user would write it in Python."""
    if problem.to_dict()["system"]["kind"] != "standard_map":
        return None

    def step(x: Any, y: Any, u: Any) -> dict[str, Any]:
        kick = 0.25 * u * np.sin(2 * np.pi * x)
        return {"x": x + y + kick, "y": y + kick}

    return problem.replaced(system=lm.systems.FunctionSystem(next=step))


def _on_full_arrays(
    problem: lm.Problem, formula: Callable[[dict[str, Any]], Any], repeats: int, samples: int
) -> float:
    """Return the seconds for all samples, measured on arrays of at most SLAB of them."""
    rng, count = np.random.default_rng(0), min(samples, SLAB)
    data = problem.to_dict()
    ranges = {
        name: (axis["low"], axis["high"])
        for name, axis in {**data["state_box"], **data["control_grid"]}.items()
    }
    full = {name: rng.uniform(low, high, count) for name, (low, high) in ranges.items()}
    return _median(lambda: formula(full), repeats) * samples / count


def _by_two(work: Callable[[Any], Any], halves: list[Any]) -> Any:
    with ThreadPoolExecutor(2) as threads:
        return sum(threads.map(work, halves))


@njit(nogil=True, cache=True)
def _sum(data):  # type: ignore[no-untyped-def]
    total = np.uint64(0)
    for k in range(len(data)):
        total += data[k]
    return total


@njit(nogil=True, cache=True)
def _gather(target, V):  # type: ignore[no-untyped-def]
    total = 0.0
    for e in range(len(target)):
        total += V[target[e]]
    return total

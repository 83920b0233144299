"""How long enclosing a box takes, against evaluating the formula at a point: both compiled.

``python -m benchmarks.enclosures`` prints a table of the systems known by name. A point is what a
loop does that Numba compiles from the formulas, written out for the purpose.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

import lmdsl as lm
from lmdsl.formulas.program import Program
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.successors.compiled import enclosing, tapes

COUNT, REPEATS = 2**17, 5
_CALLS = {"negative": "-({0})", "**": "({0})**{1}", "abs": "abs({0})"}


def _function(program: Program, names: list[str]) -> list[str]:
    """Return the body of a function of the names that returns the formulas."""
    slots = [None if value is None else repr(float(value)) for value in program.template]
    for name, slot in program.variables.items():
        slots[slot] = name
    lines = []
    for operation, operands, target, *_ in program.instructions:
        given = [slots[k] for k in operands]
        if operation in "+-*/":
            text = f"({given[0]}) {operation} ({given[1]})"
        elif operation == "**" and given[1] == "2.0":
            text = f"({given[0]}) * ({given[0]})"
        else:
            text = _CALLS.get(operation, "math." + operation + "({0})").format(*given)
        slots[target] = f"t{target}"
        lines.append(f"t{target} = {text}")
    results = ", ".join(str(slots[k]) for k in program.outputs)
    return [f"def field({', '.join(names)}):", *("    " + line for line in lines),
            f"    return ({results},)"]  # fmt: skip


def point(problem: lm.Problem) -> Callable[..., None]:
    """Return a compiled loop: images of states (B, d) under controls (B, p)."""
    flow, names = problem.flow(), [*problem.states, *problem.controls]
    d, p = len(problem.states), len(problem.controls)
    program: Any = problem.step() if flow is None else flow.field
    held: dict[str, Any] = {"math": math}
    exec("\n".join(_function(program, names)), held)  # of our own formulas
    field = numba.njit(held["field"])
    u = ", ".join(f"u[i, {j}]" for j in range(p))
    x = [f"x{k}" for k in range(d)]
    lines = ["def loop(x, u, y):", "    for i in range(len(x)):"]
    lines += [f"        x{k} = x[i, {k}]" for k in range(d)]
    if flow is None:
        lines.append(f"        r = field({', '.join([*x, u])})")
        lines += [f"        y[i, {k}] = r[{k}]" for k in range(d)]
    else:
        lines.append(f"        for _ in range({flow.substeps}):")
        before = ["", f"{flow.h / 2!r} * k1", f"{flow.h / 2!r} * k2", f"{flow.h!r} * k3"]
        for s, by in enumerate(before, 1):
            at = [f"x{k}" + (f" + {by}[{k}]" if by else "") for k in range(d)]
            lines.append(f"            k{s} = field({', '.join([*at, u])})")
        lines += [
            f"            x{k} += {flow.h / 6!r} * (k1[{k}] + 2*k2[{k}] + 2*k3[{k}] + k4[{k}])"
            for k in range(d)
        ]
        lines += [f"        y[i, {k}] = x{k}" for k in range(d)]
    space = {"field": field}
    exec("\n".join(lines), space)
    return numba.njit(space["loop"])  # type: ignore[no-any-return]


def seconds(work: Callable[[], object]) -> float:
    """Return the least time of some runs, for each of COUNT."""
    work()
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times) / COUNT


def main() -> None:
    """Print the table."""
    print("| system | point (ns) | box (ns) | ratio |\n|---|---|---|---|")
    for name, system in lm.systems.NAMED.items():
        data = dict(system.problem)
        if "substeps" in data["system"]:
            data["system"] = {**data["system"], "substeps": 2, "judged": "endpoint"}
        problem = lm.Problem.model_validate(data)
        partition, rng = Partition.of(problem), np.random.default_rng(0)
        x = rng.uniform(partition.low, partition.high, (COUNT, partition.dimension))
        u = control_vectors(problem)
        u = u[rng.integers(len(u), size=COUNT)]
        loop, y, none = point(problem), np.empty_like(x), np.zeros((COUNT, 0))
        step, size = tapes.step(problem), partition.width / 8
        given, room = enclosing.Given(x, x + size, u, none, none), None
        room = enclosing.rows(step)
        one = seconds(lambda x=x, u=u, y=y, loop=loop: loop(x, u, y))  # type: ignore[misc]
        box = seconds(lambda g=given, r=room, s=step: enclosing.enclose(s, g, r))  # type: ignore[misc]
        print(f"| {name} | {1e9 * one:.1f} | {1e9 * box:.0f} | {box / one:.1f} |")


if __name__ == "__main__":
    main()

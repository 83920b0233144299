"""What the page needs to follow the map by itself: arrays as text, programs as flat lists.

A page runs the map that was declared, or the compiled Runge-Kutta steps of an equation, under the
table of controls; of a system without formulas it draws from the rows of the finite model instead.
That is for looking at: what is proved is proved elsewhere.
"""

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput
from lmdsl.formulas.program import Program
from lmdsl.model.discretization import noise_nodes, offsets, sample_points
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.noise import NoiseNormal, NoiseUniform
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result
from lmdsl.systems import FunctionSystem, MatrixSystem

MOST_SAMPLES = 400  # sample points and noise nodes of a cell, together, that a page shows
MOST_PARTS = 20_000  # operations above which a map is not run by a page
MOST_ENTRIES = 1_000_000  # entries of the rows under the policy above which they are left out
KINDS = {"|u1": "u1", "<u2": "u2", "<i4": "i4", "<f4": "f4", "<f8": "f8"}


def packed(array: NDArray[Any]) -> dict[str, Any]:
    """Return an array as text: its bytes, little end first, deflated, in base64."""
    kind = array.dtype.newbyteorder("<").str
    held = np.ascontiguousarray(array, dtype=kind)
    text = base64.b64encode(zlib.compress(held.tobytes(), 9)).decode()
    return {"kind": KINDS[kind], "shape": list(array.shape), "data": text}


def unpacked(data: dict[str, Any]) -> NDArray[Any]:
    """Return the array that a text stands for; what the page does, for tests."""
    kind = {short: long for long, short in KINDS.items()}[data["kind"]]
    held = zlib.decompress(base64.b64decode(data["data"]))
    return np.frombuffer(held, dtype=kind).reshape(data["shape"])


def program_of(program: Program) -> dict[str, Any]:
    """Return a program as a flat list of operations on slots."""
    return {
        "slots": [None if value is None else _finite(value) for value in program.template],
        "inputs": program.variables,
        "code": [[step.operation, list(step.operands), step.target]
                 for step in program.instructions],
        "outputs": program.outputs,
    }  # fmt: skip


def _finite(value: float) -> float | str:
    """Return a constant that strict JSON can hold; the page reads words as numbers."""
    return value if np.isfinite(value) else repr(float(value)).replace("inf", "Infinity")


def map_of(problem: Problem) -> dict[str, Any] | None:
    """Return how the page makes a step, None where there are no formulas, or too long ones."""
    if isinstance(problem.system, FunctionSystem | MatrixSystem):
        return None
    flow = problem.flow()
    step: Any = problem.step() if flow is None else flow.field
    if not isinstance(step, Program) or len(step.instructions) > MOST_PARTS:
        return None
    stage = None if flow is not None and problem.cost_rate is not None else problem.stage()
    terminal = problem.terminal()
    made: dict[str, Any] = {
        "kind": "map" if flow is None else "ode",
        "program": program_of(step),
        "stage": program_of(stage) if isinstance(stage, Program) else None,
        "terminal": None if terminal is None else program_of(terminal),
        "gamma": problem.gamma,
        "discount": problem.discount,
        "noise": [_noise(name, kind) for name, kind in (problem.noise or {}).items()],
    }
    if flow is not None:
        made |= {"h": flow.h, "substeps": flow.substeps, "integrals": flow.integrals,
                 "path": problem.judged == "path",
                 "absorb": absorbed_on_way(problem.local_controller)}  # fmt: skip
    return made


def _noise(name: str, noise: Any) -> dict[str, Any]:
    if isinstance(noise, NoiseNormal):
        return {"name": name, "normal": noise.normal.std}
    if isinstance(noise, NoiseUniform):
        return {"name": name, "uniform": [noise.uniform.low, noise.uniform.high]}
    return {"name": name, "values": list(noise.values), "weights": list(noise.weights)}


def samples_of(problem: Problem) -> dict[str, Any] | None:
    """Return sample offsets within a cell, and noise nodes; evenly chosen ones of many."""
    if isinstance(problem.system, FunctionSystem | MatrixSystem):
        return None
    try:
        points, nodes = offsets(problem), noise_nodes(problem).values
    except BadInput:  # more than fit in memory
        return None
    many = max(MOST_SAMPLES // max(len(nodes), 1), 1)
    chosen = _some(points, min(many, MOST_SAMPLES))
    nodes = _some(nodes, max(MOST_SAMPLES // len(chosen), 1))
    whole = len(chosen) == len(points) and len(nodes) == len(noise_nodes(problem).values)
    return {"offsets": packed(chosen), "nodes": packed(nodes), "all": whole,
            "points": sample_points(problem)}  # fmt: skip


def _some(rows: NDArray[Any], most: int) -> NDArray[Any]:
    if len(rows) <= most:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).round().astype(np.int64))]


def rows_of(result: Result, lp: StabilizationLP) -> dict[str, Any] | None:
    """Return the rows of the finite model under the policy, by cell of C; None where too many."""
    columns = columns_of(result, lp)
    if columns is None:
        return None
    rows = lp.rows.take(columns)
    if len(rows.target) > MOST_ENTRIES:
        return None
    attractor = np.flatnonzero(result.cell_status == CellStatus.ATTRACTOR)
    inside = np.append(lp.cells, attractor[0] if len(attractor) else -1)
    return {
        "pointer": packed(rows.pointer.astype(np.int32)),
        "target": packed(inside[rows.target].astype(np.int32)),
        "share": packed(np.asarray(rows.shares.value)[rows.code].astype(np.float32)),
        "cost": packed(lp.cost[columns].astype(np.float64)),
    }


def columns_of(result: Result, lp: StabilizationLP) -> NDArray[np.int64] | None:
    """Return the column of the policy for every cell of C; None where one is missing."""
    index = result.control_index[lp.cells].astype(np.int64)
    if not lp.n or (index < 0).any():
        return None
    M = len(lp.controls)
    key = lp.cell.astype(np.int64) * M + lp.control
    wanted = np.arange(lp.n, dtype=np.int64) * M + index
    at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    return at if (key[at] == wanted).all() else None

"""What a directory says of Python functions, as far as that can be checked without calling them."""

import numpy as np

from lmdsl.common.types import Bools, Floats
from lmdsl.model.assembly.sampler import Sampler
from lmdsl.model.local.holding import within
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.results.directory.archive import names
from lmdsl.results.result import Result

# What verify notes by the keys of the problem that are functions.
NOT_EVALUATED = {
    ("system",): "the system is a Python function, which was not re-evaluated: its saved rows were "
    "checked",
    ("stage_cost",): "the stage cost is a Python function, which was not re-evaluated: its saved "
    "costs were checked",
    ("system", "stage_cost"): "system and stage cost are Python functions, which were not "
    "re-evaluated: their saved rows and costs were checked",
}


def function_notes(result: Result) -> list[str]:
    """Return what was not checked where the problem has Python functions."""
    functions = result.problem.functions
    notes = [NOT_EVALUATED[functions]]
    if "system" in functions and result.local_controller is not None:
        notes.append("what the local controller does was not checked")
    if "system" in functions and result.problem.successors == "enclosed":
        notes.append("what whole cells can meet was not checked: that is asked of the function")
    if "system" in functions and result.problem.terminal_cost is not None:
        notes.append("the terminal cost was not checked: it is paid at images of the function")
    if (result.cell_status == CellStatus.BEYOND_GAMMA).any():
        notes.append("that gamma is infeasible from the cells left out was not checked")
    return notes


def function_differences(lp: StabilizationLP, result: Result) -> list[str]:
    """Return where the saved rows of a function contradict what the file holds: sets and cost."""
    reasons, status = [], result.cell_status
    declared = CellSets.of(result.problem, result.partition)
    sets = within(declared, result.problem, lp.hold)
    for code, mask in (
        (CellStatus.ATTRACTOR, sets.attractor & declared.attractor), (CellStatus.AVOID, sets.avoid),
    ):  # fmt: skip
        if not np.array_equal(status == code, mask):
            reasons.append(f"cell_status differs from the {code.name.lower()} of the problem")
    if "stage_cost" not in result.problem.functions:
        cost = _costs(lp)
        with np.errstate(invalid="ignore"):
            slack = 1e-9 * np.abs(cost)
            wrong = ~(np.abs(lp.cost - cost) <= slack)
            if result.problem.terminal_cost is not None:  # paid at images, which are not at hand
                wrong &= ~(_entering(lp) & (lp.cost >= cost - slack))
        if wrong.any():
            reasons.append(f"cost of {int(wrong.sum())} pairs is not the stage cost of the problem")
    if not names(result, lp):
        reasons.append("the saved rows, or what the problem says, are not those of model_sha256")
    return reasons


def _costs(lp: StabilizationLP) -> Floats:
    """Return the mean stage cost of every pair, computed from the problem."""
    sampler = Sampler(lp.problem.replaced(terminal_cost=None), lp.partition)
    table = np.empty((lp.n, len(lp.controls)))
    for block in sampler.blocks(lp.cells):
        mean = sampler.costs(block, sampler.values(block))
        part = mean.T if block.cells_last else mean
        rows = slice(block.first, block.first + len(block.cells))
        table[rows, slice(*block.controls)] = part
    cost: Floats = table[lp.cell, lp.control]
    return cost


def _entering(lp: StabilizationLP) -> Bools:
    """Return which pairs lead into the attractor."""
    rows = lp.rows
    absorbed = rows.target == rows.columns
    if rows.shares.ended is not None:
        absorbed &= rows.code != rows.shares.ended  # the end by discount stands for no entry
    own = np.repeat(np.arange(rows.count), np.diff(rows.pointer))
    return np.bincount(own, absorbed, minlength=rows.count) > 0

"""What ends a run: an attractor, a discount; and what a finite model has no place for."""

import math
from fractions import Fraction
from typing import TYPE_CHECKING

from lmdsl.errors import BadInput
from lmdsl.systems import DataSystem, MatrixSystem

if TYPE_CHECKING:
    from lmdsl.problem.problem import Problem


def rate(problem: "Problem") -> Fraction:
    """Return gamma times the discount, exactly."""
    return Fraction(problem.gamma) * Fraction(1 if problem.discount is None else problem.discount)


def numbered(problem: "Problem") -> bool:
    """Return whether states are the numbers of cells: those of a finite model, as it is given."""
    whole = all(
        axis.low == -0.5 and axis.high == axis.cells - 0.5 for axis in problem.state_box.values()
    )
    system = problem.system
    return whole and isinstance(system, MatrixSystem) and not isinstance(system, DataSystem)


def require_end(problem: "Problem") -> None:
    """Refuse a problem with nothing to reach, unless its runs end by discount."""
    if not problem.attractor.empty:
        return
    if problem.discount is None:
        raise BadInput(
            "no attractor cell; give points, boxes, cells or where (only with a discount may "
            "there be none)",
            "attractor",
        )
    for key, verb in (("local_controller", "control"), ("terminal_cost", "enter")):
        if getattr(problem, key) is not None:
            raise BadInput(f"there is no attractor cell to {verb}; leave it out", key)


def require_same_data(before: "Problem", after: "Problem") -> None:
    """Refuse to change of recorded data what their rows and costs were made with."""
    old, new = before.system, after.system
    if not (isinstance(old, DataSystem) and isinstance(new, DataSystem) and old.rows is new.rows):
        return
    for key in ("state_box", "control_grid", "stage_cost", "cost_rate", "on_exit"):
        if getattr(after, key) != getattr(before, key):
            raise BadInput(
                "the rows and costs of recorded data were made with another one; call "
                "lmdsl.from_data again",
                key,
            )


def require_fit(problem: "Problem") -> None:
    """Refuse what a finite model has no place for."""
    system = problem.system
    if not isinstance(system, MatrixSystem):
        return
    rows = system.rows
    cells = math.prod(axis.cells for axis in problem.state_box.values())
    controls = math.prod(axis.count() for axis in problem.control_grid.values())
    if cells != rows.cells:
        raise BadInput(f"{cells} cells; the matrices have {rows.cells}", "state_box")
    if controls != rows.controls:
        raise BadInput(f"{controls} controls; the matrices have {rows.controls}", "control_grid")
    for where in ("noise", "local_controller"):
        if getattr(problem, where) is not None:
            raise BadInput("a finite model has none; leave it out", where)
    if problem.on_exit == "clip" and not isinstance(
        system, DataSystem
    ):  # data were moved while they were binned
        raise BadInput(
            "'clip' moves images into the box, and a finite model has rows instead; leave it out",
            "on_exit",
        )
    if problem.sampling.count(problem.states) != 1 or problem.sampling.kind != "grid":
        raise BadInput(
            'a finite model is not sampled; write {"kind": "grid", "per_axis": 1}', "sampling"
        )
    sure = isinstance(system, DataSystem) and system.confidence is not None
    if sure and problem.terminal_cost is not None:
        raise BadInput("the bounds of a confidence do not know it; leave one of them out",
                       "terminal_cost")  # fmt: skip
    if system.best_reward is not None and not rate(problem) < 1:
        raise BadInput(
            f"{problem.gamma!r} times the discount {problem.discount or 1!r} is not below 1, and "
            "rewards are maximised; lower one of them (discount=0.99, say)",
            "gamma",
        )

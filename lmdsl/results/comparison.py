"""Several backends on the same LP, side by side."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.common import html, inputs
from lmdsl.common.records import Reported
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.errors import BadInput, printable, shown
from lmdsl.machine.deadline import TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.optimize.policies import bellman
from lmdsl.problem import Problem, given
from lmdsl.results.job import not_compiled
from lmdsl.results.result import Result
from lmdsl.results.solving import TOLERANCE, solve
from lmdsl.results.status import Status

# Compared where none is named: those that every installation has.
BACKENDS = ("policy-iteration", "highs", "clarabel", "cvxpy")

HEAD = (
    "backend", "status", "cost", "lower bound", "gap", "gap before polish", "polish", "iterations",
    "seconds",
)  # fmt: skip


@dataclass(frozen=True)
class Agreement(Reported):
    """How far the verified results agree.

    Attributes
    ----------
    cost
        Largest relative difference of the costs.
    controls
        Share of cells whose controls are equal, or within 1e-9 relative of optimal in every
        result's own value.
    value
        Largest max |V_i - V_j| / V.
    """

    cost: float
    controls: float
    value: float


@dataclass(frozen=True)
class Comparison(Reported):
    """Results by backend, in the order asked for, and their agreement.

    Attributes
    ----------
    results
        One result per backend.
    agreement
        Over the verified results; None if fewer than two.
    """

    results: tuple[Result, ...]
    agreement: Agreement | None

    @property
    def exit_status(self) -> int:
        """3 if not stabilizable, else 4 if any failed, else 1 if any is unverified, else 0."""
        found = {result.exit_status for result in self.results}
        return next((code for code in (3, 4, 1) if code in found), 0)

    def table(self) -> str:
        """Return the comparison as text."""
        rows = [HEAD, *(_row(result) for result in self.results)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(HEAD))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
        lines.insert(1, "  ".join("-" * w for w in widths))
        return "\n".join(line.rstrip() for line in [*lines, *self._notes()])

    __str__ = table

    def _repr_html_(self) -> str:
        rows = [_row(result) for result in self.results]
        return html.grid(HEAD, rows, "Comparison", "\n".join(self._notes()))

    def _notes(self) -> list[str]:
        """Return what is said below the table."""
        failed = [result for result in self.results if result.status != Status.VERIFIED]
        notes = [printable(f"{result.backend}: {result.message}") for result in failed]
        if self.agreement:
            a = self.agreement
            notes.append(
                f"agreement: costs within {a.cost:.2g}, values within {a.value:.2g}, "
                f"{100 * a.controls:.4g} % of the controls equal or tied"
            )
        return notes


def _row(result: Result) -> tuple[str, ...]:
    def number(value: float | None, digits: str) -> str:
        return "-" if value is None else format(value, digits)

    return (
        printable(str(result.backend)),
        result.status,
        number(result.cost, ".10g"),
        number(result.lower_bound, ".10g"),
        number(result.gap, ".2g"),
        number(result.gap_before_polish if result.polish_steps else result.gap, ".2g"),
        str(result.polish_steps if result.polish_steps is not None else "-"),
        str(result.iterations if result.iterations is not None else "-"),
        number(result.seconds.solve, ".3f"),
    )


@own_arithmetic
def compare(
    problem: Problem | StabilizationLP | FilePath,
    backends: Sequence[Any] = BACKENDS,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float | None = None,
    progress: Progress | bool | None = None,
) -> Comparison:
    """Solve the same LP with several backends and compare the verified answers.

    Parameters
    ----------
    problem
        A problem, the path of its file, or its compiled LP.
    backends
        As for :func:`lmdsl.solve`, each alone or with an algorithm: ``"highs:simplex"``.
    tolerance, progress
        As for :func:`lmdsl.solve`.
    time_limit
        Seconds for compiling, and again for each backend.

    Raises
    ------
    BadInput
        As for :func:`lmdsl.solve`; also where no backend is named.
    """
    progress = told(progress)
    if isinstance(backends, str):
        raise BadInput(f"name the backends in a list: [{shown(backends)}]", "backends")
    inputs.kind(backends, Sequence, "backends", "a list of backends")
    problem = given(problem, StabilizationLP)
    if not backends:
        raise BadInput("no backend is named; name at least one", "backends")
    if isinstance(problem, Problem):
        began = time.perf_counter()
        try:
            lp = compile(problem, progress, time_limit)
        except TimeLimitReached as error:
            known = problem, tolerance, error, time.perf_counter() - began
            return Comparison(tuple(not_compiled(name, *known) for name in backends), None)
    else:
        lp = problem
    results = tuple(
        solve(lp, backend, tolerance=tolerance, time_limit=time_limit, progress=progress)
        for backend in backends
    )
    return Comparison(results, _agreement(lp, [r for r in results if r.status == Status.VERIFIED]))


def _agreement(lp: StabilizationLP, results: list[Result]) -> Agreement | None:
    if len(results) < 2:
        return None
    costs = np.array([result.cost for result in results])
    values = np.array([result.value[lp.cells] for result in results])
    controls = np.array([result.control_index[lp.cells] for result in results])
    lowest = values.min(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.where(lowest > 0, (values.max(axis=0) - lowest) / lowest, values.max(axis=0))
    top = float(costs.max())
    best = bellman.improve(lp, lowest).value
    near = bellman.tied(lp, lowest, best, 1e-9)
    M = len(lp.controls)
    key = lp.cell.astype(np.int64) * M + lp.control
    agreed = (controls == controls[0]).all(axis=0)
    tied = np.ones(lp.n, dtype=np.bool_)
    for chosen in controls:
        tied &= near[np.searchsorted(key, np.arange(lp.n, dtype=np.int64) * M + chosen)]
    return Agreement(
        cost=float(top - costs.min()) / top if top > 0 else 0.0,
        controls=float((agreed | tied).mean()),
        value=float(spread.max()),
    )

"""Trials: a choice compiled, solved and run on the true map, and how well it serves."""

import math
from dataclasses import dataclass
from typing import Any

from lmdsl.advice.suggesting.choices import Combination
from lmdsl.common.records import Reported
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result
from lmdsl.results.solving import solve

STARTS = 400  # runs of each
BROKEN = 4  # how many times a run counts that does not arrive
# Step limit of the runs: times as many as the longest way to A has at least, within two bounds.
LONGER, LEAST_STEPS, MOST_STEPS = 10, 200, 2_000


@dataclass(frozen=True)
class Attempt(Reported):
    """What became of a choice.

    Attributes
    ----------
    step, cells, sampling
        The choice: sampling time (None of a map), cells of each axis, the sampling.
    coverage
        Share of the free cells that are stabilizable; None where there is no such problem.
    arrives
        Share of runs of the true map from these that arrive; None where there is no controller.
    score
        Of what is not avoided, the part that is in the attractor or, times the fourth power of
        the share that arrives, stabilizable: a promise that is broken counts four times.
    message
        Why there is no such problem, or no controller; else empty.
    """

    step: float | None
    cells: dict[str, int]
    sampling: dict[str, Any]
    coverage: float | None
    arrives: float | None
    score: float
    message: str = ""

    def words(self) -> str:
        """Return the choice in words."""
        cells = "x".join(map(str, self.cells.values()))
        step = "" if self.step is None else f"step {self.step:.4g}, "
        return f"{step}cells {cells}, {sampling_words(self.sampling)}"

    def __str__(self) -> str:
        if self.coverage is None or self.arrives is None:
            return f"{self.words()}: {self.message}"
        return (
            f"{self.words()}: coverage {100 * self.coverage:.1f} %, "
            f"of the runs {100 * self.arrives:.1f} % arrive"
        )


def sampling_words(sampling: dict[str, Any]) -> str:
    """Return a sampling in words."""
    corners = " and corners" * bool(sampling.get("corners"))
    if sampling["kind"] == "grid":
        k = sampling["per_axis"]
        each = "x".join(map(str, k.values())) if isinstance(k, dict) else k
        return f"{each} sample{'s' * (k != 1)} an axis{corners}"
    return f"{sampling['points']} {sampling['kind']} points{corners}"


def tried(
    problem: Problem, choice: Combination, deadline: Deadline, accurate: bool = False
) -> Attempt:
    """Try a choice; runs are those of the compiled steps, or ``accurate`` ones.

    Raises
    ------
    TimeLimitReached
        The deadline has passed.
    """
    deadline.raise_if_over("trying")
    try:
        changed = choice.of(problem)
    except BadInput as error:
        cells = {name: round(n) for name, n in zip(problem.states, choice.aim, strict=True)}
        sampling = problem.replaced(sampling=choice.sampling).sampling
        return Attempt(choice.step, cells, plain(sampling), None, None, 0.0, str(error))
    known = (
        choice.step,
        {name: axis.cells for name, axis in changed.state_box.items()},
        plain(changed.sampling),
    )
    try:
        result = solve(changed, time_limit=Deadline(deadline.left))
        deadline.raise_if_over("trying")
    except BadInput as error:
        return Attempt(*known, None, None, 0.0, str(error))
    coverage = result.coverage.share if result.coverage is not None else None
    if (result.control_index < 0).all() or not coverage:
        return Attempt(*known, coverage, None, 0.0, result.message)
    assert result.lp is not None
    longest = int(result.lp.tree[0].max(initial=1))
    steps = min(max(LONGER * longest, LEAST_STEPS), MOST_STEPS)
    runs = result.simulate(STARTS, steps, as_compiled=not accurate)
    kept = (runs.reached if runs.aimed else runs.cycling) / runs.starts
    return Attempt(*known, coverage, kept, score(result, kept))


def plain(sampling: Any) -> dict[str, Any]:
    """Return a sampling as a problem file has it."""
    data: dict[str, Any] = sampling.model_dump(mode="json", exclude_none=True)
    if not data.get("corners"):
        data.pop("corners", None)
    return {"kind": data["kind"], **data}


def score(result: Result, arrives: float) -> float:
    """Return how well a result serves; see :class:`Attempt`."""
    status = result.cell_status
    whole = len(status) - int((status == CellStatus.AVOID).sum())
    attractor = int((status == CellStatus.ATTRACTOR).sum())
    served = attractor + int((status == CellStatus.STABILIZED).sum()) * arrives**BROKEN
    return served / whole if whole and math.isfinite(served) else 0.0

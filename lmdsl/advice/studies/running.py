"""``study``: variants in turn, each begun where the one before ended."""

import os
from collections.abc import Sequence
from typing import Any

from lmdsl.advice.studies.keeping import Folder
from lmdsl.advice.studies.knobs import Variation, variants
from lmdsl.advice.studies.orders import orders
from lmdsl.advice.studies.record import Study, StudyRow
from lmdsl.common import inputs
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP
from lmdsl.problem import Problem, given
from lmdsl.problem.whole.changing import gamma_alone
from lmdsl.results.result import Result
from lmdsl.results.solving import TOLERANCE, solve

STEPS = 10_000  # step limit of runs


@own_arithmetic
def study(
    problem: Problem | FilePath,
    *,
    cells: Sequence[Any] | None = None,
    samples: Sequence[int] | None = None,
    gamma: Sequence[float] | None = None,
    step: Sequence[float] | None = None,
    backends: Sequence[str] | None = None,
    out: str | os.PathLike[str] | None = None,
    starts: int = 1_000,
    tolerance: float = TOLERANCE,
    time_limit: float | None = None,
    progress: Progress | bool | None = None,
) -> Study:
    """Solve variants of a problem in turn, and see what they make of cost, coverage and runs.

    Variants that differ in gamma or backend share a compiled model, and each begins at the
    controller of the one before.

    Parameters
    ----------
    problem
        A problem, or the path of its file.
    cells
        Numbers of cells: each one number for all axes, numbers in the order of the axes, or numbers
        by name (then the others keep theirs).
    samples
        Numbers of sample points: on each axis of a ``grid``, else in a cell. Corners stay.
    gamma, step, backends
        Values; the step is integrated as finely as the problem's own.
    out
        A folder: every variant is kept there as it is finished, as a result directory, and a study
        that was interrupted, or asks for more, goes on there.
    starts
        Runs of the true map for each variant, 0 for none.
    tolerance
        As for :func:`lmdsl.solve`.
    time_limit
        Seconds for each variant, and again for its runs.
    progress
        Called with (stage, fraction done, or -1); True shows it on stderr.

    Raises
    ------
    BadInput
        A value makes no sense, or the folder is no study's. A variant that is no problem, as cells
        too large for the attractor, is a row with the status ``bad_input``.
    """
    progress = told(progress)
    problem = given(problem)
    knobs = {"cells": cells, "samples": samples, "gamma": gamma, "step": step, "backends": backends}
    asked = variants(problem, knobs)
    options = {"starts": inputs.whole(starts, "starts", 0), "tolerance": tolerance,
               "time_limit": time_limit}  # fmt: skip
    if out is not None and problem.functions:
        raise BadInput("a study of Python functions cannot be kept; leave it out", "out")
    folder = None if out is None else Folder(out, options)
    work = _Work(problem, options, folder, progress)
    rows = []
    for i, variant in enumerate(asked):
        if progress:
            progress("study", i / len(asked))
        rows.append(work.row(variant))
    found = Study(problem.name, tuple(rows), orders(rows))
    if folder is not None:
        folder.write_table(found)
    return found


class _Work:
    """What is at hand while variants are solved in turn: a compiled model, and a controller."""

    def __init__(
        self,
        problem: Problem,
        options: dict[str, Any],
        folder: Folder | None,
        progress: Progress | None,
    ) -> None:
        self.problem, self.options, self.folder = problem, options, folder
        self.progress = progress
        self.lp: StabilizationLP | None = None
        self.compiled: Problem | None = None  # what the model was compiled from
        self.last: Result | str | None = None  # the last controller, or the key of one that is kept

    def row(self, asked: Variation) -> StudyRow:
        """Return what becomes of a variant, or became of it before."""
        key = ""
        try:
            problem = asked.of(self.problem).replaced(gamma=asked.gamma)
            if self.folder is not None:
                key = self.folder.key(problem, asked.backend)
                kept = self.folder.rows.get(key)
                if kept is not None and asked.is_of(kept):
                    self.last = key
                    return kept
            result = self._solved(problem, asked)
        except BadInput as error:
            return StudyRow(**asked._asdict(), status="bad_input", message=str(error))
        row = self._ran(result, asked)
        if self.folder is not None:
            self.folder.add(key, row, result)
        return row

    def _solved(self, problem: Problem, asked: Variation) -> Result:
        deadline = Deadline.of(self.options["time_limit"])
        asked_for: Problem | StabilizationLP = problem
        fresh = not self._at_hand(problem)
        if fresh:
            self.lp = None  # two models need not fit into memory
        elif self.lp is not None:
            asked_for = self.lp.with_gamma(problem.gamma)
        result = solve(
            asked_for, asked.backend, tolerance=self.options["tolerance"], time_limit=deadline,
            start=self._start(), progress=self.progress,
        )  # fmt: skip
        if fresh:
            self.lp, self.compiled = result.lp, problem
        if (result.control_index >= 0).any():
            self.last = result
        return result

    def _at_hand(self, problem: Problem) -> bool:
        """Return whether the compiled model serves a problem, with another gamma."""
        if self.lp is None or self.compiled is None:
            return False
        same = self.compiled.replaced(gamma=problem.gamma) == problem
        return same and not gamma_alone(self.compiled, problem)

    def _start(self) -> Result | None:
        """Return the controller to begin with, None where none is known."""
        if isinstance(self.last, str):
            self.last = None if self.folder is None else self.folder.result(self.last)
            if self.last is not None and (self.last.control_index < 0).all():
                self.last = None
        return self.last

    def _ran(self, result: Result, asked: Variation) -> StudyRow:
        """Return the row of a result, with runs of the true map where there is a controller."""
        starts, runs = self.options["starts"], None
        if starts and (result.control_index >= 0).any() and result.stabilizable_cells:
            if self.progress:
                self.progress("simulate", -1.0)
            try:
                runs = result.simulate(starts, STEPS, time_limit=self.options["time_limit"])
            except (TimeLimitReached, BadInput):  # no time, or no memory for so many
                runs = None
        seconds, covered = result.seconds, result.coverage
        aimed = runs is not None and runs.aimed
        return StudyRow(
            **asked._asdict(),
            status=str(result.status),
            cost=result.cost,
            lower_bound=result.lower_bound,
            gap=result.gap,
            coverage=None if covered is None else covered.share,
            attractor=_share(result.attractor_cells, result.cells),
            pairs=result.pairs,
            arrives=runs.reached / runs.starts if runs is not None and aimed else None,
            interval=runs.interval if runs is not None and aimed else None,
            steps=runs.steps["q50"] if runs is not None and runs.steps else None,
            time=runs.times["q50"] if runs is not None and runs.times else None,
            iterations=result.iterations,
            compile_seconds=seconds.compile,
            solve_seconds=seconds.solve,
            verify_seconds=seconds.verify,
            message=result.message,
        )


def _share(some: int | None, cells: int | None) -> float | None:
    return some / cells if some is not None and cells else None

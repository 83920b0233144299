"""Repair: pairs that lose runs of the true map are dropped, until enough of the first C arrives.

A round solves, proves what becomes of C under the controller, and drops the pairs at which a proved
loss begins or that keep runs elsewhere; where there are none, those with most undecided volume. The
best round is the answer. As dropping pairs can take cells out of C, shares are those of the volume
of the first C.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Progress
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.boxes import named
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.dropping import list_sha256
from lmdsl.model.successors.staying import Staying
from lmdsl.problem.problem import Problem
from lmdsl.proof.optimum.averages import volumes
from lmdsl.proof.record import TARGET, Proof
from lmdsl.proof.search import LOST, STAYS, UNDECIDED
from lmdsl.results.result import Result
from lmdsl.results.summary import Proved
from lmdsl.systems import MatrixSystem

Pairs = NDArray[np.int64]  # rows (cell, control)
Again = Callable[[Pairs], Result]  # solves without some pairs

STALE = 4  # rounds that bring nothing, after which the search ends
PART = 0.5  # part of the time that is left which a proof may take
WORST = 0.5  # share of the largest undecided volume of a cell that is as bad


class _Round(NamedTuple):
    """A result, its proof, and what the proof says of the first C."""

    result: Result
    proof: Proof
    arrives: float

    def worth(self, target: float) -> tuple[bool, float, float]:
        """Return what makes a round better than others: the target first, then that less is lost.

        Below the target what arrives decides.
        """
        if self.arrives >= target:
            return True, -self.proof.lost, self.arrives
        return False, self.arrives, -self.proof.lost

    def done(self, target: float) -> bool:
        """Return whether nothing is left to repair."""
        return self.arrives >= target and self.proof.lost == 0 and self.proof.stays == 0


def require_provable(target: Any, problem: Problem, restrict_to_gamma: bool) -> None:
    """Refuse before the work what cannot be repaired."""
    if not (inputs.is_number(target) and 0 < target <= 1):
        raise BadInput(f"{shown(target)} is no share; give a number above 0, at most 1", "proved")
    if problem.functions or isinstance(problem.system, MatrixSystem):
        known = (
            "a Python function" if problem.functions else "a system of which only rows are known"
        )
        raise BadInput(f"{known} cannot be enclosed; write formulas, or leave it out", "proved")
    if problem.attractor.empty:
        raise BadInput("there is no attractor to arrive in; declare one, or leave it out", "proved")
    if restrict_to_gamma:
        raise BadInput("not together with restrict_to_gamma; lower gamma instead", "proved")


def repaired(
    first: Result, again: Again, target: float, deadline: Deadline, progress: Progress | None
) -> Result:
    """Return the best result of repairing a first one; its key ``proved`` says how far it got."""
    if first.lp is None or not (first.control_index >= 0).any():
        cells = first.stabilizable_cells or 0
        return replace(first, proved=Proved(target, 0.0, 0, cells, first.lower_bound))
    repair = _Repair(first, again, target, deadline, progress)
    best = repair.search()
    if best.arrives < target and first.lp.sure_levels is not None:
        best = repair.surely(best)
    return repair.answer(best)


class _Repair:
    """The search for a controller of which enough is proved."""

    def __init__(
        self, first: Result, again: Again, target: float, deadline: Deadline,
        progress: Progress | None,
    ) -> None:  # fmt: skip
        self.first, self.again, self.target = first, again, target
        self.deadline, self.progress = deadline, progress
        assert first.lp is not None
        self.lp: StabilizationLP = first.lp
        self.why = ""

    def search(self) -> _Round:
        """Drop pairs until enough is proved and nothing is lost, or nothing helps."""
        trial = best = self.proved(self.first)
        dropped = np.zeros((0, 2), dtype=np.int64) if self.lp.dropped is None else self.lp.dropped
        stale = 0
        while not best.done(self.target):
            pairs = self.culprits(trial, alone=stale >= 2)
            if not len(pairs) or stale >= STALE:
                self.why = "no other control helps"
                break
            dropped = np.concatenate([dropped, pairs])
            next_ = self.solved(dropped, self.target)
            if next_ is None:
                break
            trial = next_
            better = trial.worth(self.target) > best.worth(self.target)
            best, stale = (trial, 0) if better else (best, stale + 1)
        return best

    def solved(self, dropped: Pairs, least: float = 0.0) -> _Round | None:
        """Solve without some pairs, and prove; None where C is too small, or there is no time."""
        if self.deadline():
            self.why = "the time limit was reached"
            return None
        result = self.again(dropped)
        if not result.verified or result.lp is None:
            self.why = f"without more pairs the problem is {result.status}"
            return None
        if result.lp.n < least * self.lp.n:
            self.why = f"without more pairs C has {result.lp.n} of {self.lp.n} cells"
            return None
        return self.proved(result)

    def proved(self, result: Result) -> _Round:
        """Prove what becomes of a result's C."""
        part = result.lp.n / self.lp.n if result.lp is not None else 1.0
        left = self.deadline.left
        limit = None if left is None else max(PART * left, 0.0)
        wanted = min(1.0, max(self.target / part, TARGET))  # less would leave losses undecided
        proof = result.prove(wanted, limit, progress=self.progress)
        return _Round(result, proof, proof.arrives * part)

    def culprits(self, trial: _Round, alone: bool = False) -> Pairs:
        """Return pairs of the controller to drop, shape (D, 2).

        Those at which a loss begins or that keep runs elsewhere, of cells that have other controls
        first, unless that did not help: the others, that stand ``alone``, take their cells with
        them. Else the most undecided ones of cells that have other controls.
        """
        lp, proof = trial.result.lp, trial.proof
        assert lp is not None
        begins = (proof.kind == STAYS) | ((proof.kind == LOST) & (proof.level == 1))
        several = lp.cells[np.diff(lp.pair_pointer) > 1]
        guilty = np.unique(proof.cell[begins])
        able = guilty[np.isin(guilty, several)]
        cells = able if len(able) and not alone else guilty
        if not len(cells):
            waits = _volume(proof, UNDECIDED, lp.partition.size)[several]
            cells = several[(waits > 0) & (waits >= WORST * waits.max(initial=0.0))]
        index = trial.result.control_index[cells].astype(np.int64)
        return np.stack([cells, index], axis=-1)

    def surely(self, best: _Round) -> _Round:
        """Return what the law of sure arrival does, where that is better."""
        if self.deadline():
            return best
        keep = Staying.of(self.lp, self.deadline).surely()
        if not keep.any() or len(np.unique(self.lp.cell[keep])) <= best.arrives * self.lp.n:
            return best
        cell, control = self.lp.cells[self.lp.cell[~keep]], self.lp.control[~keep]
        dropped = np.stack([cell, control.astype(np.int64)], axis=-1)
        if self.lp.dropped is not None:
            dropped = np.concatenate([self.lp.dropped, dropped])
        found = self.solved(dropped)
        if found is None or found.worth(self.target) <= best.worth(self.target):
            return best
        return found

    def answer(self, best: _Round) -> Result:
        """Return the result of a round, with what was proved of it, and why it is not more."""
        result, lp, proof = best.result, best.result.lp, best.proof
        assert lp is not None
        pairs = 0 if lp.dropped is None else len(lp.dropped)
        said = (
            f"{100 * best.arrives:.4f} % of the first C is proved to arrive, "
            f"{100 * proof.lost * lp.n / self.lp.n:.4f} % to be lost"
        )
        if pairs:
            said += (
                f", without {pairs} pairs: lower_bound and gap are of the model without them; that "
                f"of the declared model is {self.first.lower_bound!r}"
            )
        if best.arrives < self.target:
            said = f"the target {self.target!r} is missed: {said}; {self._advice(best)}"
        return replace(
            result,
            message=f"{result.message}; {said}",
            proof=proof,
            declared_lower=self.first.lower if pairs else None,
            proved=Proved(
                self.target,
                best.arrives,
                pairs,
                self.lp.n,
                self.first.lower_bound,
                list_sha256(lp.dropped),
            ),
        )

    def _advice(self, best: _Round) -> str:
        """Return where most is missing, at which pair, and what would help."""
        lp, result, proof = best.result.lp, best.result, best.proof
        assert lp is not None
        missing = sum(_volume(proof, kind, lp.partition.size) for kind in (UNDECIDED, LOST, STAYS))
        gone = (self.first.cell_status == CellStatus.STABILIZED) & (result.control_index < 0)
        if gone.sum() >= np.sum(missing):
            cell = named(lp.partition, int(np.argmax(gone)))
            return (
                f"{int(gone.sum())} cells of it have no control left, for example {cell}; finer "
                f"control_grid or smaller cells would help"
            )
        worst = int(np.argmax(missing))
        index = int(result.control_index[worst])
        where = named(lp.partition, worst)
        u = ", ".join(f"{x:.6g}" for x in result.control_vectors[index])
        return (
            f"{self.why or 'nothing more was tried'}; most is missing in {where} under control "
            f"{index} ({u}); more time, smaller cells or a finer control_grid would help"
        )


def _volume(proof: Proof, kind: int, cells: int) -> Floats:
    """Return how much of every cell is of a kind, shape (N,), in cells."""
    some = proof.kind == kind
    found = np.bincount(proof.cell[some], volumes(proof.split[some]), minlength=cells)
    return np.asarray(found, dtype=np.float64)

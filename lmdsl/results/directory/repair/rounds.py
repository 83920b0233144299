"""The rounds of a repair: solve without some pairs, prove, and drop those at fault.

Pairs of which a state loses the run, whatever is done afterwards, are dropped beforehand: all of
them where enough of C can be kept without, else those that lose more than others of their cell.
A round solves, and drops pairs of the controller of which one of many more states is lost, until
there is none. Then it proves what becomes of C. If after a moment there are pairs at which a
proved loss begins or that keep runs elsewhere, they are dropped; else the proof goes on.
"""

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, Progress, Statuses
from lmdsl.machine.deadline import Deadline
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.successors.left_out.lossless import Lossless
from lmdsl.proof.bounds.optimum.averages import volumes
from lmdsl.proof.record import TARGET, Proof
from lmdsl.proof.search import LOST, STAYS, UNDECIDED
from lmdsl.results.directory.proved import prove
from lmdsl.results.result import Result

Pairs = NDArray[np.int64]  # rows (cell, control)
Depths = NDArray[np.int32]
Again = Callable[[Pairs], Result]  # solves without some pairs

NONE: Pairs = np.zeros((0, 2), dtype=np.int64)
STALE = 4  # rounds that bring nothing, after which the search ends
# Most seconds, and part of the time that is left, before a proof ends where pairs are at fault.
MOMENT, PART = 30.0, 0.2
EARLY = 0.35  # part of the time that is kept for a proof: then nothing more is dropped before it
SOLVED = 10  # most models of a round
LAST = 0.85  # part of the time that is left which a proof may take
SOON = 0.25  # the same where another law, that of sure arrival, waits for its turn
WORST = 0.5  # share of the largest undecided volume of a cell that is as bad


class Round(NamedTuple):
    """A result, its proof, and what the proof says of the first C.

    Attributes
    ----------
    result, proof, arrives
        ``arrives`` is the share of the first C.
    whole
        Whether the proof went on after a moment.
    """

    result: Result
    proof: Proof
    arrives: float
    whole: bool

    def worth(self, target: float) -> tuple[bool, float, float]:
        """Return what makes a round better than others: the target first, then that less is lost.

        Below the target what arrives decides.
        """
        if self.arrives >= target:
            return True, -self.proof.lost, self.arrives
        return False, self.arrives, -self.proof.lost


class Rounds:
    """The search for a controller of which enough is proved.

    Attributes
    ----------
    lp
        The model of the first result.
    lossless
        What can be kept without a loss; None where that is not known.
    why
        Why the search ended.
    part
        Part of the time that is left which a proof may take.
    """

    def __init__(
        self, first: Result, again: Again, target: float, deadline: Deadline,
        progress: Progress | None,
    ) -> None:  # fmt: skip
        assert first.lp is not None
        self.first, self.again, self.target = first, again, target
        self.deadline, self.progress = deadline, progress
        self.lp: StabilizationLP = first.lp
        self.why, self.part = "no other control helps", LAST
        self.late = 0.0 if deadline.left is None else EARLY * deadline.left
        self.lossless = Lossless.of(self.lp, deadline, progress)

    def best(self) -> Round:
        """Return the best round."""
        best: Round | None = None
        for pairs, spared in self._starts():
            found = self._from(pairs, spared)
            if best is None or (found and found.worth(self.target) > best.worth(self.target)):
                best = found
            if best is not None and (best.arrives >= self.target or spared is not None):
                break
        return best or self._proved(self.first, None, whole=True)

    def _starts(self) -> Iterator[tuple[Pairs, Bools | None]]:
        """Yield pairs to drop beforehand, and in which cells losses are put up with, shape (N,)."""
        known, pairs = self.lossless, NONE
        if known is not None and known.share >= self.target:
            pairs = known.losing()
            yield pairs, None
        if known is not None and (len(pairs) or known.share < self.target):
            yield known.losing_most()
        elif known is None:
            yield NONE, None

    def _from(self, pairs: Pairs, spared: Bools | None) -> Round | None:
        """Return the best round of those that begin without some pairs."""
        given = NONE if self.lp.dropped is None else self.lp.dropped
        stale, best = 0, None
        trial = self.solved(np.concatenate([given, pairs]), spared, self.target)
        while trial is not None:
            better = best is None or trial.worth(self.target) > best.worth(self.target)
            best, stale = (trial, 0) if better else (best, stale + 1)
            pairs = self.guilty(trial, spared, stale >= 2)
            if not len(pairs) and trial.arrives < self.target and self.deadline.left is None:
                pairs = self.undecided(trial)
            if not len(pairs) or stale >= STALE:
                break
            trial = self.solved(_dropped(trial.result, pairs), spared, self.target)
        return best if best is None or best.whole else self._proved(best.result, None, whole=True)

    def solved(self, dropped: Pairs, spared: Bools | None, least: float = 0.0) -> Round | None:
        """Solve without some pairs, and prove; None where C is too small, or there is no time."""
        for _ in range(SOLVED):
            if self.deadline():
                self.why = "the time limit was reached"
                return None
            given = 0 if self.lp.dropped is None else len(self.lp.dropped)
            result = self.first if len(dropped) == given else self.again(dropped)
            if not result.verified or result.lp is None:
                self.why = (
                    "the time ran out while it was solved without more pairs"
                    if self.deadline()
                    else f"without more pairs the problem is {result.status}"
                )
                return None
            if result.lp.n < least * self.lp.n:
                self.why = f"without more pairs C has {result.lp.n} of {self.lp.n} cells"
                return None
            pairs = self._losing_some(result, spared)
            if not len(pairs):
                break
            dropped = _dropped(result, pairs)
        return self._proved(result, spared)

    def _losing_some(self, result: Result, spared: Bools | None) -> Pairs:
        """Return pairs of the controller of which some of many states are lost.

        Where losses are put up with, in other cells only, and in those that have other controls.
        """
        lp = result.lp
        assert lp is not None
        if self.lossless is None or not self._early():
            return NONE
        control = result.control_index[lp.cells].astype(np.int64)
        pairs = self.lossless.losing_some(lp.cells, control)
        if spared is None:
            return pairs
        return pairs[~spared[pairs[:, 0]] & np.isin(pairs[:, 0], _several(lp))]

    def _early(self) -> bool:
        """Return whether there is time enough to drop pairs."""
        left = self.deadline.left
        return left is None or left > self.late

    def _proved(self, result: Result, spared: Bools | None, whole: bool = False) -> Round:
        """Prove what becomes of a result's C; the ``whole``, or until pairs are at fault."""
        part = result.lp.n / self.lp.n if result.lp is not None else 1.0
        left = self.deadline.left
        moment = time.monotonic() + (MOMENT if left is None else min(MOMENT, PART * left))
        ended = False

        def at_fault(cell: Indices, state: Statuses, level: Depths) -> bool:
            """Return whether a moment has passed, and decided boxes put pairs at fault."""
            nonlocal ended
            if not (ended or whole) and time.monotonic() > moment and self._early():
                ended = len(_faulty(cell, state, level, spared)) > 0
            return ended

        wanted = min(1.0, max(self.target / part, TARGET))  # less would leave losses undecided
        limit = None if left is None else self.part * left
        proof = prove(result, wanted, limit, self.progress, ending=at_fault)
        return Round(result, proof, proof.arrives * part, not ended)

    def guilty(self, trial: Round, spared: Bools | None, alone: bool) -> Pairs:
        """Return pairs of the controller at which a loss begins or that keep runs elsewhere.

        Those of cells that have other controls, unless that did not help: those that stand
        ``alone`` take their cells with them. Where no loss is put up with all of them.
        """
        lp, proof = trial.result.lp, trial.proof
        assert lp is not None
        cells = np.unique(_faulty(proof.cell, proof.kind, proof.level, spared))
        able = cells[np.isin(cells, _several(lp))]
        return _pairs(trial, able if len(able) and not alone else cells)

    def undecided(self, trial: Round) -> Pairs:
        """Return the most undecided pairs of the controller, of cells that have other controls."""
        lp = trial.result.lp
        assert lp is not None
        several = _several(lp)
        waits = volume(trial.proof, UNDECIDED, lp.partition.size)[several]
        return _pairs(trial, several[(waits > 0) & (waits >= WORST * waits.max(initial=0.0))])


def _faulty(cell: Indices, state: Statuses, level: Depths, spared: Bools | None) -> Indices:
    """Return the cells of boxes at which a loss begins that is not put up with, or that stay."""
    begins = (state == LOST) & (level == 1)
    if spared is not None:
        begins &= ~spared[cell]
    return np.asarray(cell[begins | (state == STAYS)])


def _dropped(result: Result, pairs: Pairs) -> Pairs:
    """Return the pairs that a model lacks, and some more."""
    assert result.lp is not None
    before = result.lp.dropped
    return pairs if before is None else np.concatenate([before, pairs])


def _several(lp: StabilizationLP) -> Indices:
    """Return the cells of a model that have several controls."""
    return np.asarray(lp.cells[np.diff(lp.pair_pointer) > 1])


def _pairs(trial: Round, cells: Indices) -> Pairs:
    """Return the pairs of the controller in some cells."""
    return np.stack([cells, trial.result.control_index[cells].astype(np.int64)], axis=-1)


def volume(proof: Proof, kind: int, cells: int) -> Floats:
    """Return how much of every cell is of a kind, shape (N,), in cells."""
    some = proof.kind == kind
    found = np.bincount(proof.cell[some], volumes(proof.split[some]), minlength=cells)
    return np.asarray(found, dtype=np.float64)

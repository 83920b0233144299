"""Repair: pairs that lose runs of the true map are dropped, until enough of the first C arrives.

The best of all rounds (rounds.py) is the answer. As dropping pairs can take cells out of C, shares
are those of the volume of the first C.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.types import Progress
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.grid.boxes import named
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.left_out.dropping import list_sha256
from lmdsl.model.successors.left_out.staying import Staying
from lmdsl.problem.problem import Problem
from lmdsl.proof.search import LOST, STAYS, UNDECIDED
from lmdsl.results.directory.repair.rounds import LAST, SOON, Again, Round, Rounds, volume
from lmdsl.results.result import Result
from lmdsl.results.summary import Proved
from lmdsl.systems import MatrixSystem


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
    rounds = Rounds(first, again, target, deadline, progress)
    rounds.part = SOON if deadline.left is not None and _sure_enough(rounds) else LAST
    best = rounds.best()
    rounds.part = LAST
    if best.arrives < target and first.lp.sure_levels is not None:
        best = _surely(rounds, best)
    return _answer(rounds, best)


def _sure_enough(rounds: Rounds) -> bool:
    """Return whether the cells that surely arrive are as many as are asked for."""
    lp = rounds.lp
    if lp.sure_levels is None:
        return False
    return int((lp.sure_levels[lp.cells] > 0).sum()) >= rounds.target * lp.n


def _surely(rounds: Rounds, best: Round) -> Round:
    """Return what the law of sure arrival does, where that is better."""
    lp = rounds.lp
    if rounds.deadline():
        return best
    try:
        keep = Staying.of(lp, rounds.deadline).surely()
    except TimeLimitReached:
        rounds.why = "the time ran out while the law of sure arrival was looked for"
        return best
    if not keep.any() or len(np.unique(lp.cell[keep])) <= best.arrives * lp.n:
        return best
    cell, control = lp.cells[lp.cell[~keep]], lp.control[~keep]
    dropped = np.stack([cell, control.astype(np.int64)], axis=-1)
    if lp.dropped is not None:
        dropped = np.concatenate([lp.dropped, dropped])
    found = rounds.solved(dropped, None)
    if found is None or found.worth(rounds.target) <= best.worth(rounds.target):
        return best
    return found


def _answer(rounds: Rounds, best: Round) -> Result:
    """Return the result of a round, with what was proved of it, and why it is not more."""
    result, lp, proof, first = best.result, best.result.lp, best.proof, rounds.first
    assert lp is not None
    n, known = rounds.lp.n, rounds.lossless
    pairs = 0 if lp.dropped is None else len(lp.dropped)
    said = (
        f"{100 * best.arrives:.4f} % of the first C is proved to arrive, "
        f"{100 * proof.lost * lp.n / n:.4f} % to be lost"
    )
    if pairs:
        said += (
            f", without {pairs} pairs: lower_bound and gap are of the model without them; that "
            f"of the declared model is {first.lower_bound!r}"
        )
    if best.arrives < rounds.target:
        said = f"the target {rounds.target!r} is missed: {said}; {_advice(rounds, best)}"
    if known is not None and known.share < 1.0:
        said += (
            f"; without losing a run no controller of these cells and controls can keep more "
            f"than {100 * known.share:.4f} % of the first C"
        )
    proved = Proved(
        rounds.target, best.arrives, pairs, n, first.lower_bound, list_sha256(lp.dropped),
        None if known is None else known.share,
    )  # fmt: skip
    return replace(
        result,
        message=f"{result.message}; {said}",
        proof=proof,
        declared_lower=first.lower if pairs else None,
        proved=proved,
    )


def _advice(rounds: Rounds, best: Round) -> str:
    """Return where most is missing, at which pair, and what would help."""
    result, proof, partition = best.result, best.proof, rounds.lp.partition
    missing = sum(volume(proof, kind, partition.size) for kind in (UNDECIDED, LOST, STAYS))
    gone = (rounds.first.cell_status == CellStatus.STABILIZED) & (result.control_index < 0)
    if gone.sum() >= np.sum(missing):
        return (
            f"{int(gone.sum())} cells of it have no control left, for example "
            f"{named(partition, int(np.argmax(gone)))}; finer control_grid or smaller cells would "
            "help"
        )
    worst = int(np.argmax(missing))
    index = int(result.control_index[worst])
    u = ", ".join(f"{x:.6g}" for x in result.control_vectors[index])
    why = "the time limit ended the proof" if proof.stopped else rounds.why
    return (
        f"{why}; most is missing in {named(partition, worst)} under control {index} ({u}); "
        "more time, smaller cells or a finer control_grid would help"
    )

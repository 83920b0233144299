"""From a problem and a controller to a proof: what arrives, is lost, or stays, box by box."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, Progress, Statuses
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.progress import Forecast
from lmdsl.proof.bounds.chance import chances
from lmdsl.proof.bounds.flights.following import Flights
from lmdsl.proof.bounds.flights.refining import SLACK as RAISED
from lmdsl.proof.bounds.flights.refining import close, refine
from lmdsl.proof.bounds.optimum.bracket import bound as best
from lmdsl.proof.bounds.tightening import arriving, tighten
from lmdsl.proof.cover import Cover, node_bytes
from lmdsl.proof.deciding import settling
from lmdsl.proof.images.entering import entered
from lmdsl.proof.loop import Loop
from lmdsl.proof.prover import Prover
from lmdsl.proof.record import Proof
from lmdsl.proof.search import ARRIVES, LOST, STAYS, UNDECIDED

# Images are widened by so much, in cells, when boxes are chosen, but not when they are checked:
# other versions of elementary functions differ by less.
SLACK = 2.0**-36

# Without a time limit bounds of the cost are tightened until there are so many times as many boxes,
# or so many.
GROWN, FEW = 4, 200_000
BRACKET = 0.3  # part of a time limit that is kept for a lower bound of what any law costs
BOXED = 0.2  # part of what is left then for boxes, where parts of cells can be followed after it
CHANCE = 0.15  # part that is kept for the probability to arrive, with noise
DECIDING = 0.7  # part of a time limit after which no more is decided, and bounds are tightened


Holds = Callable[[Bools], bool | None]  # whether what enters these attractor cells stays in A
# Told the cells of boxes, what is known of them, and their levels: whether that is enough.
Ending = Callable[[Indices, Statuses, NDArray[np.int32]], bool]


def prove(
    loop: Loop, target: float, deadline: Deadline, holds: Holds, progress: Progress | None,
    bracket: bool = False, ending: Ending | None = None,
) -> Proof:  # fmt: skip
    """Prove what becomes of the volume of C, until the target is reached or nothing helps.

    For a ``bracket``, bound from below what any law costs there, too. ``holds`` is asked of the
    attractor cells that what arrives can enter. Where ``ending`` ends it, bounds are not tightened.
    """
    began = time.monotonic()
    images, partition = loop.images(SLACK, loop.whole(deadline)), loop.partition
    each = node_bytes(partition.dimension, len(images.noise[0]))
    memory.require(3.0 * each * partition.size, "the boxes of the proof")
    whole, left = deadline, deadline.left
    progress = progress and Forecast(progress, target, left)
    if bracket and left is not None:
        left *= 1.0 - BRACKET
        deadline = Deadline(left)
    prover = Prover(Cover(partition, loop.status), images, loop.factor, loop.entry(images))
    likely = loop.noisy and not loop.to_stay
    if likely and left is not None:
        left *= 1.0 - CHANCE
        deadline = Deadline(left)
    flights = Flights(loop, SLACK, RAISED)
    bounded, stopped = _work((prover, flights), loop, target, deadline, progress, ending)
    arrays = boxes(prover, chances(prover, Deadline(left and CHANCE * left)) if likely else None)
    leaves = prover.cover.leaves()
    leaves = leaves[(prover.cover.tree.images[leaves] > 0)]
    ends = leaves[prover.cover.tree.state[leaves] == ARRIVES]
    kept = holds(entered(prover.cover, ends, loop.attractor))
    del prover
    followed = bounded and flights.able and not close(arrays)
    above = refine(flights, arrays, deadline, progress) if followed else None
    bound = best(loop, *_most(arrays, partition.size), whole, progress, SLACK) if bracket else None
    seconds = time.monotonic() - began
    return Proof.of(
        arrays, loop, seconds=seconds, holds=kept, target=target, above=above, bound=bound,
        stopped=stopped,
    )  # fmt: skip


def _work(
    own: tuple[Prover, Flights], loop: Loop, target: float, deadline: Deadline,
    progress: Progress | None, ending: Ending | None,
) -> tuple[bool, bool]:  # fmt: skip
    """Decide what becomes of boxes, then tighten the bounds of the cost; return whether it did.

    And whether there was no time to decide more.
    """
    prover, flights = own

    def ended() -> bool:
        return ending is not None and ending(*_decided(prover))

    def enough(shares: Floats) -> bool:
        """Return whether the target is reached, or out of reach and little is left to know."""
        reached = shares[STAYS if loop.to_stay else ARRIVES]
        open_ = shares[UNDECIDED]
        if reached >= target or (reached + open_ < target and open_ < 1.0 - target):
            return True
        return bool(shares[LOST] + shares[STAYS] > 0) and ended()

    left = deadline.left
    until = Deadline(left and DECIDING * left)
    prover.run(enough, until, progress)
    stopped = until()
    few = max(GROWN * len(prover.cover.leaves()), FEW)
    if ended():
        leaves = arriving(prover)
        settling.refine(prover.search, leaves, prover.factor, np.zeros(len(leaves)))
        return False, stopped
    some = deadline
    if flights.able and deadline.left is not None:
        some = Deadline(BOXED * deadline.left)
    tighten(prover, lambda boxes: left is None and boxes > few, some, progress)
    return True, stopped


def _decided(prover: Prover) -> tuple[Indices, Statuses, NDArray[np.int32]]:
    """Return the cells of leaves, what is known of them, and their levels."""
    tree, leaves = prover.cover.tree, prover.cover.leaves()
    leaves = leaves[tree.images[leaves] > 0]
    return tree.cell[leaves].astype(np.int64), tree.state[leaves], tree.level[leaves]


def _most(arrays: dict[str, NDArray[Any]], N: int) -> tuple[float, Indices]:
    """Return more than any upper bound of boxes that arrive: larger lower bounds are of no use.

    And the cells, those from which the cost may be least first.
    """
    arrives = arrays["class"] == ARRIVES
    cost, first = arrays["cost"][arrives], np.full(N, np.inf)
    np.minimum.at(first, arrays["cell"][arrives], cost)
    most = 2.0 * float(cost[np.isfinite(cost)].max(initial=1.0))
    return most, np.argsort(first, kind="stable")


def boxes(prover: Prover, chance: Floats | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of a proof, the leaves by cell, once bounds are tightened.

    ``chance`` is by node.

    So are levels of what arrives; those of what is lost are here.
    """
    cover = prover.cover
    tree = cover.tree
    leaves = cover.leaves()
    leaves = leaves[tree.images[leaves] > 0]
    lost = leaves[tree.state[leaves] == LOST]
    lost = lost[np.argsort(tree.level[lost], kind="stable")]
    settling.refine(prover.search, lost, prover.factor, np.zeros(len(lost)))
    leaves = leaves[np.argsort(tree.cell[leaves], kind="stable")]
    state = tree.state[leaves]
    arrives, ends = state == ARRIVES, (state == ARRIVES) | (state == LOST)
    return {
        "cell": tree.cell[leaves].astype(np.int64), "split": tree.split[leaves],
        "place": tree.place[leaves], "class": state,
        "level": np.where(ends, tree.level[leaves], 0).astype(np.int32),
        "cost": np.where(arrives, tree.cost[leaves], 0.0),
        "lower": np.where(arrives, tree.least[leaves], 0.0),
        **({} if chance is None else {"probability": chance[leaves]}),
    }  # fmt: skip

"""Runs of the true map over ranks: who starts where and what noise they meet is drawn as in one
process, the steps of the runs are divided among the ranks.

What must hold: what becomes of every run does not depend on the number of ranks. Draws are made by
all alike, from one seed; a step of some runs is that of all, cut where loops over arrays begin
anew. Every rank reads the controls and statuses of the whole box: 5 bytes a cell.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import arrays, inputs
from lmdsl.common.types import Floats, Guard, Statuses
from lmdsl.control.controller import Controller
from lmdsl.control.loop import ClosedLoop, draw_starts
from lmdsl.control.simulation import Simulation, simulate
from lmdsl.control.steps import Moved, Steps
from lmdsl.distributed.answer import Answer
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController
from lmdsl.model.sets import Mass, scaled
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Ranks
from lmdsl.results.directory import vectors
from lmdsl.results.result import Result
from lmdsl.systems.named import NotStored

ALIGNED = 64  # runs: their steps are divided at multiples, where no loop is in the middle of a word


@dataclass(frozen=True, eq=False)
class Controlled:
    """A controller and its cells, whole on every rank; shape (N,) each.

    Attributes
    ----------
    control_index, cell_status
        As of a Result.
    """

    problem: Problem
    partition: Partition
    control_vectors: Floats
    control_index: NDArray[np.int32]
    cell_status: Statuses


def gathered(ranks: Ranks, answer: Answer) -> Controlled:
    """Return the controller of an answer on every rank; collective."""
    index, status = (
        np.concatenate([*ranks.exchange(dict.fromkeys(range(ranks.count), own)).values()])
        for own in (answer.control_index, answer.cell_status)
    )
    return Controlled(answer.problem, answer.partition, answer.control_vectors, index, status)


def stored(result: Result) -> Controlled:
    """Return the controller of a saved result, which every rank reads: its files are mapped."""
    return Controlled(result.problem, result.partition, result.control_vectors,
                      result.control_index, result.cell_status)  # fmt: skip


def saved(answer: Answer, path: Path) -> Controlled:
    """Return the controller of an answer that all ranks have saved, mapped from its files."""
    N, found = answer.partition.size, []
    for name in ("control_index", "cell_status"):
        with open(path / f"{name}.npy", "rb") as file:
            found.append(arrays.mapped(file, f"{name}.npy", (N,), vectors.TYPES[name]))
    return Controlled(answer.problem, answer.partition, answer.control_vectors, *found)


def simulated(
    ranks: Ranks,
    law: Controlled,
    starts: int = 10_000,
    steps: int = 10_000,
    seed: int = 0,
    hold: int = 1_000,
    time_limit: float | Deadline | None = None,
) -> Simulation:
    """Run the true map under a controller, as :meth:`lmdsl.Result.simulate` does; collective."""
    asked = starts, steps, seed, hold, time_limit
    starts, steps, seed, hold, deadline = ranks.agreed(lambda: _asked(law, *asked))
    rng = np.random.default_rng(seed)
    first = ranks.rank == 0
    drawn = ranks.agreed(lambda: _starts(law, starts, rng) if first else None)
    x, state = ranks.share((drawn, rng.bit_generator.state) if first else None)
    assert x is not None
    rng = np.random.default_rng(seed)
    rng.bit_generator.state = state
    loop = ranks.agreed(lambda: DividedLoop(ranks, law, deadline))
    return simulate(loop, x.copy(), steps, rng, hold, AskedTogether(ranks, deadline))


def _asked(
    law: Controlled, starts: Any, steps: Any, seed: Any, hold: Any, time_limit: Any
) -> tuple[int, int, int, int, Deadline]:
    """Return what is asked for; BadInput where it cannot be."""
    if (law.control_index < 0).all():
        raise BadInput("there is no controller to simulate")
    starts, steps = inputs.whole(starts, "starts"), inputs.whole(steps, "steps")
    hold, seed = inputs.whole(hold, "hold"), inputs.seed(seed)
    memory.require(8 * starts * (16 * len(law.partition.names) + 12), "runs")
    return starts, steps, seed, hold, Deadline.of(time_limit)


def _starts(law: Controlled, count: int, rng: np.random.Generator) -> Floats:
    cells = np.flatnonzero(law.cell_status == CellStatus.STABILIZED)
    weight = scaled(Mass(law.problem, law.partition, lambda: None).on(cells))
    if not len(cells) or not weight.any():
        raise BadInput("there is no stabilizable cell to start from")
    return draw_starts(law.partition, cells, weight, count, rng)


class AskedTogether(Deadline):
    """A deadline that all ranks ask together; it raises nothing, as ranks do not all look then."""

    def __init__(self, ranks: Ranks, deadline: Deadline) -> None:
        super().__init__(None)
        self.seconds, self.ranks, self.deadline = deadline.seconds, ranks, deadline

    def __call__(self) -> bool:
        """Return whether the time is up on any rank; collective."""
        return self.ranks.any(self.deadline())

    def raise_if_over(self, doing: str) -> None:
        """Do nothing."""


class DividedLoop(ClosedLoop):
    """The true map under a controller, whose steps ranks divide among them."""

    def __init__(self, ranks: Ranks, law: Controlled, deadline: Deadline) -> None:
        attractor = law.cell_status == CellStatus.ATTRACTOR
        try:
            local = LocalController.of(law.problem, law.partition, attractor)
        except NotStored:
            local = None
        controller = Controller(law.partition, law.control_vectors, law.control_index, local)
        super().__init__(law.problem, controller, law.cell_status)
        self.ranks, self.deadline = ranks, deadline

    @cached_property
    def steps(self) -> Steps:
        """What makes the steps."""
        return DividedSteps(self.ranks, super().steps, self.deadline)


class DividedSteps:
    """Steps of runs, of which each rank makes a part."""

    def __init__(self, ranks: Ranks, steps: Steps, deadline: Deadline) -> None:
        self.ranks, self.whole = ranks, steps
        self.guard = partial(deadline.raise_if_over, "simulating")

    @property
    def method(self) -> str:
        """How they are made, in words."""
        return self.whole.method

    def move(self, values: Mapping[str, Floats], guard: Guard, absorb: bool, pieces: int) -> Moved:
        """See :meth:`lmdsl.control.steps.Steps.move`; collective.

        Few runs are moved by every rank alike: that takes less than to ask each other.
        """
        count = max(len(x) for x in values.values() if np.ndim(x))
        if count <= ALIGNED:
            return self.whole.move(values, lambda: None, absorb, pieces)
        words = -(-count // ALIGNED)
        cuts = [min(count, ALIGNED * (words * k // self.ranks.count))
                for k in range(self.ranks.count + 1)]  # fmt: skip
        own = slice(cuts[self.ranks.rank], cuts[self.ranks.rank + 1])
        mine = {name: x[own] if np.ndim(x) else x for name, x in values.items()}

        def moved() -> Moved | None:
            if own.start == own.stop:
                return None
            return self.whole.move(mine, self.guard, absorb, pieces)

        every = [part for part in self.ranks.told(moved) if part is not None]
        lengths = [len(part.cell) for part in every]
        parts: list[Any] = [
            np.broadcast_to(part.part, n) for part, n in zip(every, lengths, strict=True)
        ]
        return Moved(
            np.concatenate([part.state for part in every]),
            np.concatenate([part.cell for part in every]),
            np.concatenate([part.cost for part in every]),
            np.concatenate([part.drawn for part in every], axis=1),
            np.concatenate(parts),
        )

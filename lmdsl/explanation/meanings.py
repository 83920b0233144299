"""What the causes mean, in words, by what a problem asks for."""

from dataclasses import dataclass

from lmdsl.common.types import Statuses
from lmdsl.explanation import finite
from lmdsl.explanation.one_cell import NAMES
from lmdsl.model.grid.boxes import Region
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem

MEANING = {
    CellStatus.ESCAPES: "every control sends some sample out of the box, into avoid, or to "
    "a value that is not finite",
    CellStatus.TRAPPED: "the attractor cannot be reached by controls that are safe",
    CellStatus.LEADS_TO_THESE: "the attractor can be reached, but not without the risk of a cell "
    "that is lost",
}


@dataclass(frozen=True)
class LostCells:
    """The cells that one cause keeps outside C.

    Attributes
    ----------
    name
        ``escapes``, ``trapped`` or ``leads to these``.
    cells
        How many there are.
    regions
        Disjoint boxes of such cells only, largest first.
    elsewhere
        Number of the cells in none of these boxes.
    """

    name: str
    cells: int
    regions: tuple[Region, ...]
    elsewhere: int


def meanings(problem: Problem) -> dict[str, str]:
    """Return what each cause means, by its name."""
    meaning = dict(MEANING)
    if isinstance(problem.system, MatrixSystem):
        meaning[CellStatus.ESCAPES] = finite.escaping(problem)
    elif problem.admissible is not None:
        meaning[CellStatus.ESCAPES] += ", or is not admissible at one"
    if problem.successors == "enclosed":
        meaning[CellStatus.ESCAPES] = (
            "of no control enclosures show that all of the cell stays in the box and outside avoid"
        )
    if problem.ends_in_time:
        meaning[CellStatus.LEADS_TO_THESE] = "no control is without the risk of a cell that is lost"
    return {NAMES[status]: text for status, text in meaning.items()}


def unheld(problem: Problem, partition: Partition, status: Statuses) -> str | None:
    """Return why no attractor cell holds; None where some does, or none is asked to."""
    if (status == CellStatus.ATTRACTOR).any():
        return None
    return holding.unheld(problem, partition)

"""The finite model of a problem."""

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from reference.grid import Axis

ATTRACTOR, STABILIZED, ESCAPES, TRAPPED, LEADS, AVOID = range(6)
Pair = tuple[int, int]  # (cell, control index)
Row = tuple[dict[int, Fraction], Fraction, Fraction]


@dataclass
class ReferenceModel:
    """The finite model of a problem. A pair is (cell, control index)."""

    problem: dict[str, Any]
    axes: list[Axis]
    controls: list[tuple[float, ...]]
    N: int
    M: int
    S: int  # sample points times noise nodes of positive weight
    points: int
    noise: list[tuple[tuple[float, ...], float]]
    attractor: set[int]
    avoid: set[int]
    # pair -> {target cell, "absorbed" or "escaped": number of sample points for each noise node}
    counts: dict[Pair, dict[int | str, list[int]]]
    # pair -> ({target cell outside A: share}, share absorbed, share escaped), exact, sum 1; with a
    # discount b the sum is b, and with the rest the run ends
    rows: dict[Pair, Row]
    admissible: set[Pair]
    cost: dict[Pair, float]  # of every admissible pair
    cell_status: list[int] = field(default_factory=list)
    surviving: list[Pair] = field(default_factory=list)
    m: dict[int, float] = field(default_factory=dict)
    discount: Fraction = Fraction(1)
    # cell -> control of the attractor cells that hold; None where the problem asks for none
    hold: dict[int, int] | None = None
    proved: Any = None  # the bracket of gamma_bar, once it is known

    @property
    def ends(self) -> bool:
        """Whether every run ends by discount so soon that its cost is finite."""
        return self.discount < 1 and Fraction(self.problem.get("gamma", 1.0)) * self.discount < 1

    @property
    def C(self) -> list[int]:
        return [c for c, status in enumerate(self.cell_status) if status == STABILIZED]

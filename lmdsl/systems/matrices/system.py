"""A finite model as a system: its rows are given, nothing is sampled."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from lmdsl.common.strict_model import Number
from lmdsl.common.types import Floats, Guard, Indices
from lmdsl.errors import BadInput
from lmdsl.systems.base import Names, StateMap, System
from lmdsl.systems.matrices.rows import GivenRows


class MatrixSystem(System):
    """A finite model: every pair's row and cost as given, see :func:`lmdsl.from_matrices`.

    Attributes
    ----------
    rows
        The exact rows and the costs of all pairs.
    best_reward
        R, where rewards are maximised: the costs are then R minus the reward, and entering the
        attractor costs R/(1 - gamma b), what is missed there for ever. None for costs.
    """

    scope: ClassVar[str] = "the finite model as it was given"
    kind: Literal["matrices"] = "matrices"
    rows: GivenRows = Field(exclude=True)
    best_reward: Number | None = None

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Say that no JSON is a finite model."""
        return {"not": {}}

    def compile(self, names: Names) -> StateMap:
        """See :meth:`System.compile`; the map is defined, but refuses to be evaluated."""
        return GivenMap()

    @property
    def pays_all(self) -> bool:
        """Whether the costs of the rows are all that is paid, or the stage cost comes beside."""
        return False

    def missed(self, gamma: float, discount: float | None) -> float:
        """Return R/(1 - gamma b), what R in every step for ever would earn; 0 for costs."""
        if self.best_reward is None:
            return 0.0
        left = 1 - Fraction(gamma) * Fraction(1 if discount is None else discount)
        return float(Fraction(self.best_reward) / left)


class Draws:
    """Draws the next cells of runs of a finite model."""

    def __init__(self, rows: GivenRows) -> None:
        self.rows = rows
        self.key = rows.cell.astype(np.int64) * rows.controls + rows.control
        self.up_to = np.concatenate([[0.0], np.cumsum(rows.values()[rows.code])])

    def __call__(self, cell: Indices, control: Indices, rng: np.random.Generator) -> Indices:
        """Return the next cell of each run, -1 where it escapes or has no such pair."""
        if not len(self.key):
            return np.full(len(cell), -1, dtype=np.int64)
        wanted = cell * self.rows.controls + control
        k = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        first, last = self.rows.pointer[k], self.rows.pointer[k + 1]
        low, high = self.up_to[first], self.up_to[last]
        entry = np.searchsorted(self.up_to, low + rng.random(len(k)) * (high - low), "right") - 1
        entry = np.clip(entry, first, last - 1)
        known = (cell >= 0) & (control >= 0) & (self.key[k] == wanted)
        return np.where(known, self.rows.target[entry], -1).astype(np.int64)

    def costs(self, cell: Indices, control: Indices) -> Floats:
        """Return the cost of each run's pair; 0 where it has no such pair."""
        if not len(self.key):
            return np.zeros(len(cell))
        wanted = cell * self.rows.controls + control
        k = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        known = (cell >= 0) & (control >= 0) & (self.key[k] == wanted)
        return np.where(known, self.rows.cost[k], 0.0)


class GivenMap:
    """Stands for the map of a finite model, which has none."""

    formulas = enclose = None
    live, effort, work = 1, 0.0, 0.0

    def __call__(self, values: Mapping[str, Any], guard: Guard | None = None) -> tuple[Floats, ...]:
        """Refuse."""
        raise BadInput("a finite model has rows, and no map that could be evaluated", "system")

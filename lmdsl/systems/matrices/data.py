"""Recorded transitions as a system: a finite model whose rows are counts over their totals."""

from fractions import Fraction
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from lmdsl.common.strict_model import Declared, Fractional, plain
from lmdsl.common.types import Indices
from lmdsl.errors import BadInput
from lmdsl.systems.matrices.system import MatrixSystem

Whole = Annotated[int, Field(ge=0, le=10**15), BeforeValidator(plain)]


class Recorded(Declared):
    """How many transitions were given, and what became of them.

    Attributes
    ----------
    transitions
        Transitions given.
    used
        Those in the rows.
    outside
        Dropped: they start outside the box.
    unmatched
        Dropped: their control is not on the grid within the tolerance.
    few
        Dropped: their pair has fewer than ``min_count``.
    """

    transitions: Whole
    used: Whole
    outside: Whole = 0
    unmatched: Whole = 0
    few: Whole = 0


class DataSystem(MatrixSystem):
    """Recorded transitions, binned into rows; see :func:`lmdsl.from_data`.

    Attributes
    ----------
    recorded
        What became of the transitions given.
    confidence
        Level at which the intervals of all probabilities hold together; None: none are made.
    smoothing
        What is added to the count of every recorded successor of a pair.
    """

    scope: ClassVar[str] = "the finite model of the recorded data"
    assumes: ClassVar[str] = (
        "no transition occurs that was not recorded (assumption `support`), and those recorded are "
        "independent draws in their cells (assumption `independence`)"
    )
    kind: Literal["data"] = "data"  # type: ignore[assignment]
    recorded: Recorded
    confidence: Fractional | None = None
    smoothing: Annotated[float, Field(ge=0, allow_inf_nan=False), BeforeValidator(plain)] = 0.0

    @model_validator(mode="after")
    def _counts(self) -> Self:
        """Refuse shares that are no counts over their total."""
        p, q = Fraction(self.smoothing).as_integer_ratio()
        if any((n - p) % q or not q <= n - p < q * 2**62 for n in self.rows.numerator):
            raise BadInput("the shares of the rows are no counts with this smoothing", "smoothing")
        return self

    @property
    def pays_all(self) -> bool:
        """Whether the costs of the rows are all that is paid: those at the recorded states."""
        return True

    def counted(self) -> Indices:
        """Return how often every transition of the rows was recorded, shape (E,)."""
        p, q = Fraction(self.smoothing).as_integer_ratio()
        by_code = [(numerator - p) // q for numerator in self.rows.numerator]
        return np.array(by_code, dtype=np.int64)[self.rows.code]

    def totals(self) -> Indices:
        """Return how often every pair of the rows was recorded, shape (K,)."""
        counted = self.counted()
        return np.add.reduceat(counted, self.rows.pointer[:-1]) if len(counted) else counted

    @property
    def counts(self) -> Indices:
        """How often each cell was left under each control, shape (N, M)."""
        table = np.zeros((self.rows.cells, self.rows.controls), dtype=np.int64)
        table[self.rows.cell, self.rows.control] = self.totals()
        return table

"""What a contestant is, and what its module offers.

A module has ``CONTESTANTS`` and a class ``Solver``. A solver is made from a model and an algorithm;
that, ``renew`` and ``value`` are outside the clock, ``solve`` is inside. Packages are imported
when a solver is made, never when the module is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol


@dataclass(frozen=True)
class Contestant:
    """One algorithm of one package.

    Attributes
    ----------
    name
        As shown in the tables.
    module
        Import name of the module with its ``Solver``.
    algorithm
        Given to the ``Solver``.
    package
        Import name of what it needs, ``""`` for nothing.
    at
        The gammas it is made for: ``"one"``, ``"below one"``, ``"own"`` (the model's own) or
        ``"any"``.
    accuracy
        The largest relative error of V that counts as the same value.
    note
        Shown with its rows.
    """

    name: str
    module: str
    algorithm: str = ""
    package: str = ""
    at: str = "any"
    accuracy: float = 1e-6
    note: str = ""

    def serves(self, gamma: float, own: float) -> bool:
        """Return whether it takes part at this gamma of a model."""
        fits = {"one": gamma == 1, "below one": gamma < 1, "own": gamma == own, "any": True}
        return fits[self.at]


class Solver(Protocol):
    """The class ``Solver`` of a rival's module."""

    def __init__(self, model: Any, algorithm: str) -> None:
        """Build the model in the rival's own form."""

    def renew(self) -> None:
        """Make whatever must be new before each solve."""

    def solve(self) -> None:
        """Solve; this is timed."""

    def value(self) -> Any:
        """Return V, shape (n,), or None where the contestant makes none."""

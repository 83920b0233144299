"""The contestants: one short module per package."""

from __future__ import annotations

from benchmarks.rivals import (
    clarabel,
    highs,
    ipopt,
    mdpsolver,
    ours,
    quantecon,
    storm,
    value_iteration,
)
from benchmarks.rivals.base import Contestant

MODULES = (ours, storm, quantecon, mdpsolver, value_iteration, highs, clarabel, ipopt)
ALL: list[Contestant] = [one for module in MODULES for one in module.CONTESTANTS]
OURS = ours.CONTESTANTS[0].name
"""The contestant that all ratios refer to."""


def chosen(words: list[str] | None) -> list[Contestant]:
    """Return lmdsl's contestants and those whose name contains one of the words, case aside.

    Raises
    ------
    ValueError
        A word occurs in no name.
    """
    if words is None:
        return ALL
    for word in words:
        if not any(word.lower() in one.name.lower() for one in ALL):
            raise ValueError(f"{word!r} is part of no contestant's name")
    ours_too = ["lmdsl", *words]
    return [one for one in ALL if any(word.lower() in one.name.lower() for word in ours_too)]

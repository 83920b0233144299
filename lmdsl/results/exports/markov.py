"""The finite model as others hold a Markov decision process: exact, every target once in a row.

State i < n is the i-th cell of C, state n the attractor; with a discount state n + 1 is where runs
end by it.
"""

from fractions import Fraction
from typing import Any

from lmdsl.common import inputs
from lmdsl.errors import BadInput
from lmdsl.model.lp import StabilizationLP


def require_model(lp: Any) -> None:
    """Refuse what has no geometric weight 1, no cell or no start.

    Raises
    ------
    BadInput
        Gamma is not 1, C is empty, or no cell of C has m > 0.
    """
    inputs.kind(lp, StabilizationLP, "lp", "a compiled LP; see lmdsl.compile")
    if lp.gamma != 1:
        raise BadInput(
            f"{lp.gamma!r} is not accepted: expected total costs of model checkers have no "
            "weight, so only a problem with gamma = 1 can be exported",
            "gamma",
        )
    if not lp.n:
        raise BadInput("the stabilizable set is empty; there is no model to export")
    if not lp.weight.any():
        raise BadInput("no cell of `measure` is stabilizable; there is no initial state")


def last_states(lp: StabilizationLP) -> dict[int, str]:
    """Return the states that are no cells of C, and their labels."""
    last = {lp.n: "attractor"}
    if lp.rows.shares.ended is not None:
        last[lp.n + 1] = "ended"
    return last


def exact_row(lp: StabilizationLP, k: int) -> list[tuple[int, Fraction]]:
    """Return a row as (target, probability), each target once and ascending."""
    row, numerator = lp.rows.exact(k), dict[int, int]()
    if lp.rows.shares.ended is not None:
        row[-1] = (lp.n + 1, row[-1][1])  # the last entry
    for j, count in row:
        numerator[j] = numerator.get(j, 0) + count
    return [(j, Fraction(numerator[j], lp.rows.total(k))) for j in sorted(numerator)]

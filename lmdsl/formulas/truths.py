"""What is known of conditions on boxes: they hold everywhere, or may hold somewhere."""

from collections.abc import Callable
from typing import Any, Final

from lmdsl.formulas.intervals import Interval

# It holds everywhere, it may hold somewhere: arrays of booleans.
Truth = tuple[Any, Any]


def _less(a: Interval, b: Interval) -> Truth:
    return a.high < b.low, a.low < b.high


def _less_equal(a: Interval, b: Interval) -> Truth:
    return a.high <= b.low, a.low <= b.high


def _equal(a: Interval, b: Interval) -> Truth:
    one = (a.low == a.high) & (b.low == b.high)
    meet = (a.low <= b.high) & (b.low <= a.high)
    return one & meet, meet


def _not(a: Truth) -> Truth:
    return ~a[1], ~a[0]


def _both(a: Truth, b: Truth) -> Truth:
    return a[0] & b[0], a[1] & b[1]


def _one_of(a: Truth, b: Truth) -> Truth:
    return a[0] | b[0], a[1] | b[1]


COMPARED: Final[dict[str, Callable[[Interval, Interval], Truth]]] = {
    "<": _less, "<=": _less_equal, ">": lambda a, b: _less(b, a),
    ">=": lambda a, b: _less_equal(b, a), "==": _equal, "!=": lambda a, b: _not(_equal(a, b)),
}  # fmt: skip

JOINED: Final[dict[str, Callable[..., Truth]]] = {"and": _both, "or": _one_of, "not": _not}

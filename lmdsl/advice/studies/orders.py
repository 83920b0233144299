"""Observed orders of convergence: how fast a quantity settles as the cells, say, get smaller.

If q(h) = q + c h^p at three widths h1 > h2 > h3, then (q1 - q2)/(q2 - q3) = (h1^p - h2^p)/(h2^p -
h3^p), which grows with p from ln(h1/h2)/ln(h2/h3) on: p is the order, and q the limit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lmdsl.advice.studies.record import StudyRow
from lmdsl.common.records import Reported

QUANTITIES = ("cost", "coverage")  # the share that arrives is known too roughly
LEAST, MOST = 1e-3, 20.0  # orders that are told
SAME = 1e-9  # relative difference of volumes that is rounding


@dataclass(frozen=True)
class Order(Reported):
    """How a quantity settles as one knob is turned, all others held.

    Attributes
    ----------
    knob, quantity
        ``cells``, ``samples`` or ``step``; ``cost`` or ``coverage``.
    held
        The values of the other knobs.
    widths
        h of the three finest variants: of cells the mean width of an axis in parts of the box, of
        samples one over their number on an axis, of steps the step.
    values
        The quantity there.
    order
        p of q + c h^p through them; None where they do not settle like that.
    limit
        q; None where p is.
    why
        Why no order is told, where more variants of this kind would not help.
    """

    knob: str
    quantity: str
    held: dict[str, Any]
    widths: tuple[float, float, float]
    values: tuple[float, float, float]
    order: float | None
    limit: float | None
    why: str = ""

    def __str__(self) -> str:
        held = ", ".join(f"{name} {_plain(value)}" for name, value in self.held.items())
        place = f" ({held})" * bool(held)
        if self.order is None or self.limit is None:
            why = self.why or "no order can be told yet"
            return f"{self.quantity} over {self.knob}{place}: {why}"
        return (
            f"{self.quantity} over {self.knob}{place}: order {self.order:.2g}, "
            f"limit about {self.limit:.6g}"
        )


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return "x".join(str(count) for count in value.values())
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def orders(rows: Sequence[StudyRow]) -> tuple[Order, ...]:
    """Return the orders that three or more variants show, by knob, quantity and group."""
    found = []
    for knob in ("cells", "samples", "step"):
        groups: dict[str, list[StudyRow]] = {}
        for row in rows:
            if getattr(row, knob) is not None:
                groups.setdefault(str(held_of(row, knob)), []).append(row)
        for group in groups.values():
            held = _turned(held_of(group[0], knob), rows)
            for quantity in QUANTITIES:
                order = _order(knob, quantity, held, group)
                found += [order] if order is not None else []
    return tuple(found)


def held_of(row: StudyRow, knob: str) -> dict[str, Any]:
    """Return the values of all knobs but one."""
    names = ("cells", "samples", "step", "gamma", "backend")
    return {name: getattr(row, name) for name in names if name != knob}


def _turned(held: dict[str, Any], rows: Sequence[StudyRow]) -> dict[str, Any]:
    """Return those of the held values that are not the same in all rows."""
    return {
        name: value
        for name, value in held.items()
        if any(getattr(row, name) != value for row in rows)
    }


def width(row: StudyRow, knob: str) -> float:
    """Return h of a variant: smaller is finer."""
    if knob == "cells":
        return float(math.prod(row.cells.values()) ** (-1 / len(row.cells)))
    return 1 / row.samples if knob == "samples" and row.samples else float(row.step or 1.0)


def _order(
    knob: str, quantity: str, held: dict[str, Any], rows: Sequence[StudyRow]
) -> Order | None:
    known = {width(row, knob): getattr(row, quantity) for row in rows}
    known = {h: q for h, q in known.items() if q is not None and math.isfinite(q)}
    h = sorted(known, reverse=True)[-3:]
    if len(h) < 3:
        return None
    q = tuple(known[each] for each in h)
    why = _differ(rows, [*h], knob)
    p = None if why else observed(*h, *q)
    limit = None if p is None else q[2] + (q[2] - q[1]) * h[2] ** p / (h[1] ** p - h[2] ** p)
    if limit is not None and (limit < 0 or (quantity == "coverage" and limit > 1)):
        p, limit = None, None  # they have not begun to settle
    return Order(knob, quantity, held, (h[0], h[1], h[2]), (q[0], q[1], q[2]), p, limit, why)


def _differ(rows: Sequence[StudyRow], h: Sequence[float], knob: str) -> str:
    """Return that variants are of different problems, if they are: their attractors differ."""
    of = {width(row, knob): row.attractor for row in rows}
    sizes = [size for each in h if (size := of[each]) is not None]
    if not sizes or max(sizes) - min(sizes) <= SAME * max(sizes):
        return ""
    told = ", ".join(f"{100 * size:.4g} %" for size in sizes)
    return (
        f"no order, the attractor differs ({told} of the cells): choose numbers of cells whose "
        "faces are those of the declared set"
    )


def observed(h1: float, h2: float, h3: float, q1: float, q2: float, q3: float) -> float | None:
    """Return p with (q1 - q2)/(q2 - q3) = (h1^p - h2^p)/(h2^p - h3^p); None where none is told."""
    if q2 == q3 or (q1 - q2) / (q2 - q3) <= 0:
        return None
    wanted = math.log((q1 - q2) / (q2 - q3))

    def excess(p: float) -> float:
        return math.log((h1**p - h2**p) / (h2**p - h3**p)) - wanted

    low, high = LEAST, MOST
    if excess(low) > 0 or excess(high) < 0:
        return None
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return (low + high) / 2

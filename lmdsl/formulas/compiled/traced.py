"""Jets as rows of a tape: the rules of enclosures.py, written down instead of carried out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from lmdsl.formulas import intervals as iv
from lmdsl.formulas.compiled import choices, functions, machine
from lmdsl.formulas.compiled.tape import ONE, ZERO, Fixed, Slot, Value, Writer
from lmdsl.formulas.operations import CONNECTIVES, FORMULA_FUNCTIONS
from lmdsl.formulas.program import Program

_LINE: Final = Fixed(-math.inf, math.inf)
_FUNCTION: Final = 2 * iv.FUNCTION_ULPS * iv.ROUNDING


class Traced:
    """A jet to be: a value, slopes in some directions (None: zero), and an error (None: zero)."""

    def __init__(
        self, writer: Writer, value: Value, slope: Sequence[Value | None], error: Value | None
    ) -> None:
        self.writer, self.value, self.slope, self.error = writer, value, tuple(slope), error

    def like(self, x: float) -> Traced:
        """Return a number as a jet of the same directions."""
        number = Fixed(float(x), float(x)) if math.isfinite(x) else _LINE
        return Traced(self.writer, number, [None] * len(self.slope), None)

    def __add__(self, other: Any) -> Traced:
        b, to = _traced(other, self), self.writer
        value = to.add(self.value, b.value)
        slope = [_added(to, p, q) for p, q in zip(self.slope, b.slope, strict=True)]
        return Traced(to, value, slope, _rounded(to, self.error, b.error, value))

    def __sub__(self, other: Any) -> Traced:
        b, to = _traced(other, self), self.writer
        value = to.subtract(self.value, b.value)
        slope = [_subtracted(to, p, q) for p, q in zip(self.slope, b.slope, strict=True)]
        return Traced(to, value, slope, _rounded(to, self.error, b.error, value))

    def __mul__(self, other: Any) -> Traced:
        b, to = _traced(other, self), self.writer
        if b is self:
            return _chain(self, to.square(self.value), lambda: to.add(self.value, self.value))
        value = to.multiply(self.value, b.value)
        slope = [
            _added(to, _times(to, p, b.value), _times(to, q, self.value))
            for p, q in zip(self.slope, b.slope, strict=True)
        ]
        first, second = _moved(to, self.value, b.error), _moved(to, b.value, self.error)
        return Traced(to, value, slope, _rounded(to, first, second, value))

    def __truediv__(self, other: Any) -> Traced:
        b, to = _traced(other, self), self.writer
        value = to.divide(self.value, b.value)
        slope = [
            None if (rise := _subtracted(to, p, _times(to, q, value))) is None
            else to.divide(rise, b.value)
            for p, q in zip(self.slope, b.slope, strict=True)
        ]  # fmt: skip
        error, moved = self.error, _moved(to, value, b.error)
        if error is not None or moved is not None:
            error = to.emit(machine.DIVIDED, error or ZERO, moved or ZERO, b.value)
        return Traced(to, value, slope, _rounded(to, error, None, value))

    def __neg__(self) -> Traced:
        to = self.writer
        slope = [None if p is None else to.negative(p) for p in self.slope]
        return Traced(to, to.negative(self.value), slope, self.error)

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: Any) -> Traced:
        return _traced(other, self) - self


def _traced(x: Any, like: Traced) -> Traced:
    return x if isinstance(x, Traced) else like.like(x)


def _added(to: Writer, p: Value | None, q: Value | None) -> Value | None:
    return q if p is None else p if q is None else to.add(p, q)


def _subtracted(to: Writer, p: Value | None, q: Value | None) -> Value | None:
    if q is None:
        return p
    return to.negative(q) if p is None else to.subtract(p, q)


def _times(to: Writer, p: Value | None, q: Value) -> Value | None:
    return None if p is None else to.multiply(p, q)


def _moved(to: Writer, by: Value, error: Value | None) -> Value | None:
    return None if error is None else to.emit(machine.MOVED, by, error)


def _rounded(
    to: Writer, a: Value | None, b: Value | None, value: Value, share: float = iv.ROUNDING
) -> Value:
    return to.emit(machine.ROUNDED, a or ZERO, b or ZERO, value, number=share)


def _chain(
    a: Traced, value: Value, derivative: Callable[[], Value], share: float = iv.ROUNDING
) -> Traced:
    """Return g(a) from the values and derivatives of g and its own relative error."""
    to, slope, moved = a.writer, a.slope, None
    if a.error is not None or any(p is not None for p in slope):
        by = derivative()
        slope, moved = tuple(_times(to, p, by) for p in slope), _moved(to, by, a.error)
    return Traced(to, value, slope, _rounded(to, moved, None, value, share))


def _function(to: Writer, name: str, a: Value) -> Value:
    return to.emit(machine.FUNCTION + functions.NAMES.index(name), a)


# Of a function its derivative, from the writer, the operand's value and its own.
_DERIVATIVES: Final[dict[str, Callable[[Writer, Value, Value], Value]]] = {
    "sin": lambda to, a, f: _function(to, "cos", a),
    "cos": lambda to, a, f: to.negative(_function(to, "sin", a)),
    "tan": lambda to, a, f: to.add(ONE, to.square(f)),
    "exp": lambda to, a, f: f,
    "log": lambda to, a, f: to.divide(ONE, a),
    "sqrt": lambda to, a, f: to.divide(ONE, to.multiply(Fixed(2.0, 2.0), f)),
    "atan": lambda to, a, f: to.divide(ONE, to.add(ONE, to.square(a))),
    "tanh": lambda to, a, f: to.subtract(ONE, to.square(f)),
    "sinh": lambda to, a, f: _function(to, "cosh", a),
    "cosh": lambda to, a, f: _function(to, "sinh", a),
    "asin": lambda to, a, f: to.divide(ONE, _function(to, "sqrt", to.subtract(ONE, to.square(a)))),
    "acos": lambda to, a, f: to.negative(
        to.divide(ONE, _function(to, "sqrt", to.subtract(ONE, to.square(a))))
    ),
}


def _smooth(name: str) -> Callable[[Traced], Traced]:
    def apply(a: Traced) -> Traced:
        value = _function(a.writer, name, a.value)
        return _chain(a, value, lambda: _DERIVATIVES[name](a.writer, a.value, value), _FUNCTION)

    return apply


def _stepped(name: str) -> Callable[[Traced], Traced]:
    def apply(a: Traced) -> Traced:
        to = a.writer
        value = _function(to, name, a.value)
        around = _function(to, name, to.emit(machine.SPREAD, a.value))
        slope = [None if p is None else to.emit(machine.FLAT, around) for p in a.slope]
        return Traced(to, value, slope, to.emit(machine.WIDTH, value))

    return apply


def _absolute(a: Traced) -> Traced:
    to = a.writer
    slope = list(a.slope)
    if any(p is not None for p in slope):
        sign = _function(to, "sign", to.emit(machine.SPREAD, a.value))
        slope = [_times(to, p, sign) for p in slope]
    return Traced(to, to.emit(machine.ABSOLUTE, a.value), slope, a.error)


def _condition(to: Writer, name: str, a: Value, b: Value = ZERO) -> Slot:
    return to.emit(machine.CONDITION + choices.NAMES.index(name), a, b)


def _smaller(a: Traced, b: Traced) -> Traced:
    to = a.writer
    less = _condition(to, "<", a.value, b.value)
    slope = [
        None if p is None and q is None else to.emit(machine.CHOOSE, less, p or ZERO, q or ZERO)
        for p, q in zip(a.slope, b.slope, strict=True)
    ]
    error = a.error or b.error
    if a.error is not None and b.error is not None:
        error = to.emit(machine.LARGER, a.error, b.error)
    return Traced(to, to.emit(machine.SMALLER, a.value, b.value), slope, error)


def _angle(y: Traced, x: Traced) -> Traced:
    """Return atan2(y, x); on its cut, which the radius does not see, it has no slope."""
    to = y.writer
    value = to.emit(machine.TURN, y.value, x.value)
    radius = to.add(to.square(x.value), to.square(y.value))
    above, under = _condition(to, "<", ZERO, y.value), _condition(to, "<", y.value, ZERO)
    front = _condition(to, "<", ZERO, x.value)
    apart = _condition(to, "or", front, _condition(to, "or", above, under))
    jump = to.emit(machine.CHOOSE_ONE, apart, ZERO, _LINE)
    slope: list[Value | None] = []
    for p, q in zip(y.slope, x.slope, strict=True):
        rise = _subtracted(to, _times(to, p, x.value), _times(to, q, y.value))
        slope.append(None if rise is None else to.add(to.divide(rise, radius), jump))
    first, second = _moved(to, x.value, y.error), _moved(to, y.value, x.error)
    error = to.emit(machine.DIVIDED, first or ZERO, second or ZERO, radius)
    known, width = _rounded(to, error, None, value, _FUNCTION), to.emit(machine.WIDTH, value)
    return Traced(to, value, slope, to.emit(machine.CHOOSE_ERROR, apart, known, width, value))


def _power(a: Traced, b: Traced) -> Traced:
    to = a.writer
    if isinstance(b.value, Fixed) and b.value.low == b.value.high:
        return _constant_power(a, b.value.low)
    # a^b = exp(b log a), claimed only where a > 0
    log = _smooth("log")(a)
    general = _smooth("exp")(b * log)
    positive = _condition(to, "<", ZERO, a.value)
    value: Value = to.emit(machine.CHOOSE_ONE, positive, general.value, _LINE)
    value = to.add(value, to.multiply(value, Fixed(-_FUNCTION, _FUNCTION)))
    return Traced(to, value, general.slope, _rounded(to, general.error, None, value, _FUNCTION))


def _constant_power(a: Traced, p: float) -> Traced:
    to = a.writer
    if p == 0.0:
        return a.like(1.0)  # also NaN ** 0
    if p == 1.0:
        return _chain(a, _raised(to, a.value, 1.0), lambda: ONE, _FUNCTION)
    share = iv.ROUNDING if p == 2.0 else _FUNCTION

    def derivative() -> Value:
        inner = a.value if p == 2.0 else _raised(to, a.value, p - 1.0)
        return to.multiply(Fixed(p, p), inner)

    return _chain(a, _raised(to, a.value, p), derivative, share)


def _raised(to: Writer, a: Value, p: float) -> Value:
    if p == 2.0:
        return to.square(a)
    if p < 0.0:
        return to.divide(ONE, _raised(to, a, -p))
    return ONE if p == 0.0 else to.emit(machine.POWER, a, number=p)


def _remainder(a: Traced, b: Traced) -> Traced:
    to = a.writer
    turns = to.emit(machine.FLOORS, a.value, b.value)
    turned = to.subtract(a.value, to.multiply(turns, b.value))
    value = to.emit(machine.REMAINDER, turned, turns, b.value, a.value)
    around = to.emit(machine.FLOORS, to.emit(machine.SPREAD, a.value), b.value)
    jump = to.emit(machine.FLAT, around)
    slope: list[Value | None] = []
    for p, q in zip(a.slope, b.slope, strict=True):
        by = _subtracted(to, p, _times(to, q, around))
        slope.append(None if by is None else to.add(by, jump))
    moved = _moved(to, turns, b.error)  # the quotient's floor is exact
    known, width = _rounded(to, a.error, moved, value), to.emit(machine.WIDTH, value)
    one = _condition(to, "==", turns, turns)
    return Traced(to, value, slope, to.emit(machine.CHOOSE_ERROR, one, known, width, value))


def _where(condition: Traced | Value, a: Traced, b: Traced) -> Traced:
    to = a.writer
    c = _truth(condition)
    if isinstance(c, Fixed):
        return a if c.low != 0.0 else b
    value = to.emit(machine.CHOOSE, c, a.value, b.value)
    slope = [
        to.emit(machine.CHOOSE_ONE, c, p or ZERO, q or ZERO)
        for p, q in zip(a.slope, b.slope, strict=True)
    ]
    error = to.emit(machine.CHOOSE_ERROR, c, a.error or ZERO, b.error or ZERO, value)
    return Traced(to, value, slope, error)


def _truth(condition: Traced | Value) -> Value:
    return condition.value if isinstance(condition, Traced) else condition


def _joined(name: str, writer: Writer, *conditions: Traced | Value) -> Slot:
    return _condition(writer, name, *map(_truth, conditions))


def _compared(name: str) -> Callable[[Traced, Traced], Slot]:
    def apply(a: Traced, b: Traced) -> Slot:
        to, plain = a.writer, {">": "<", ">=": "<=", "!=": "=="}.get(name, name)
        first, second = (b, a) if name in (">", ">=") else (a, b)
        found = _condition(to, plain, first.value, second.value)
        return _condition(to, "not", found) if name == "!=" else found

    return apply


_PLAIN: Final[dict[str, Callable[..., Any]]] = {
    "+": Traced.__add__, "-": Traced.__sub__, "*": Traced.__mul__, "/": Traced.__truediv__,
    "negative": Traced.__neg__, "**": _power, "abs": _absolute, "min": _smaller,
    "max": lambda a, b: -_smaller(-a, -b), "atan2": _angle, "where": _where, "mod": _remainder,
    **{name: _compared(name) for name in ("<", "<=", ">", ">=", "==", "!=")},
    **{name: _smooth(name) for name in _DERIVATIVES},
    **{name: _stepped(name) for name in ("sign", "floor", "ceil", "rint")},
}  # fmt: skip


def trace(
    program: Program, values: Mapping[str, Traced], slots: list[Any] | None = None
) -> tuple[Traced, ...]:
    """Return the jets, of conditions the rows, of all formulas; ``slots`` takes all on the way."""
    like, slots = next(iter(values.values())), [] if slots is None else slots
    slots += [None if value is None else like.like(value) for value in program.template]
    for name, slot in program.variables.items():
        slots[slot] = values[name]
    for operation, operands, target, *_ in program.instructions:
        given = [slots[k] for k in operands]
        if operation in CONNECTIVES:
            slots[target] = _joined(operation, like.writer, *given)
        else:
            slots[target] = _PLAIN[operation](*given)
    return tuple(slots[slot] for slot in program.outputs)


if missing := {*FORMULA_FUNCTIONS} - {*_PLAIN}:  # a new function needs its tape
    raise NotImplementedError(f"no tape of {sorted(missing)}")

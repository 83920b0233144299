"""Formulas on intervals with derivatives: enclosures of values and of Jacobians at once.

A jet holds an interval of values and, for each of d directions, an interval of derivatives
(forward mode). At a point it differentiates a formula; on a box it feeds the mean value form
f(X) within f(c) + f'(X) (X - c), which is far tighter than evaluating f on X where the box is
small. A function with a jump (floor, sign, an undecided ``where``) gets the whole line as
derivative, so that only its range counts. Where a value may be infinite or undefined, everything
made of it is the whole line: NumPy's NaN cannot hide behind a ``max`` or a ``tanh``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from lmdsl import intervals as iv
from lmdsl.formulas import FORMULA_FUNCTIONS
from lmdsl.intervals import Interval


class Jet:
    """An enclosure of a value, shape (B,), and of its d derivatives, shape (d, B).

    Arithmetic with jets and numbers works as with arrays, so that a Runge-Kutta step written
    for arrays encloses as well.
    """

    __array_ufunc__ = None  # a NumPy number times a jet is the jet's business

    def __init__(self, value: Interval, slope: Interval) -> None:
        self.value, self.slope = value, slope

    @staticmethod
    def constant(x: Any, directions: int) -> Jet:
        """Return a number that does not vary."""
        value = Interval.point(x)
        return Jet(value, Interval.point(np.zeros((directions, *np.atleast_1d(x).shape))))

    @staticmethod
    def variable(value: Interval, k: int, directions: int) -> Jet:
        """Return the k-th of the variables with respect to which derivatives are taken."""
        slope = np.zeros((directions, *np.shape(value.low)))
        slope[k] = 1.0
        return Jet(value, Interval.point(slope))

    def __add__(self, other: Any) -> Jet:
        b = _jet(other, self)
        return _made(iv.add(self.value, b.value), iv.add(self.slope, b.slope), self, b)

    def __sub__(self, other: Any) -> Jet:
        b = _jet(other, self)
        return _made(iv.subtract(self.value, b.value), iv.subtract(self.slope, b.slope), self, b)

    def __mul__(self, other: Any) -> Jet:
        if other is self:
            return _chain(self, iv.square(self.value), iv.add(self.value, self.value))
        b = _jet(other, self)
        slope = iv.add(iv.multiply(self.slope, b.value), iv.multiply(b.slope, self.value))
        return _made(iv.multiply(self.value, b.value), slope, self, b)

    def __truediv__(self, other: Any) -> Jet:
        b = _jet(other, self)
        value = iv.divide(self.value, b.value)
        rise = iv.subtract(self.slope, iv.multiply(value, b.slope))
        return _made(value, iv.divide(rise, b.value), self, b)

    def __neg__(self) -> Jet:
        return Jet(iv.negative(self.value), iv.negative(self.slope))

    def __rmul__(self, other: float) -> Jet:
        return self * other

    def __radd__(self, other: float) -> Jet:
        return self + other


def _jet(x: Any, like: Jet) -> Jet:
    return x if isinstance(x, Jet) else Jet.constant(x, len(like.slope.low))


def _made(value: Interval, slope: Interval, *operands: Jet) -> Jet:
    """Return a result, the whole line wherever an operand or the result may not be finite."""
    sound: Any = np.isfinite(value.low) & np.isfinite(value.high)
    for a in operands:
        sound = sound & np.isfinite(a.value.low) & np.isfinite(a.value.high)
    return Jet(
        iv.either(sound, value, iv.whole(sound)),
        iv.either(sound, slope, iv.whole(sound)),
    )


def _chain(a: Jet, value: Interval, derivative: Interval) -> Jet:
    return _made(value, iv.multiply(a.slope, derivative), a)


def _one_over(x: Interval) -> Interval:
    return iv.divide(Interval.point(1.0), x)


ONE: Final = Interval.point(1.0)
_exp = iv.increasing(np.exp)
_sqrt = iv.increasing(np.sqrt, low=0.0)
_sinh = iv.increasing(np.sinh)
_tanh = iv.increasing(np.tanh)


def _cosh(x: Interval) -> Interval:
    return iv.even(x, np.cosh, iv.FUNCTION_ULPS)


def _acos(x: Interval) -> Interval:
    return iv.negative(iv.increasing(lambda t: -np.arccos(t), -1.0, 1.0)(x))


# Name of a function: its extension, and the extension of its derivative.
Extension = Callable[[Interval], Interval]
_SMOOTH: Final[dict[str, tuple[Extension, Extension]]] = {
    "sin": (iv.sine, iv.cosine),
    "cos": (iv.cosine, lambda x: iv.negative(iv.sine(x))),
    "tan": (iv.tangent, lambda x: iv.add(ONE, iv.square(iv.tangent(x)))),
    "asin": (
        iv.increasing(np.arcsin, -1.0, 1.0),
        lambda x: _one_over(_sqrt(iv.subtract(ONE, iv.square(x)))),
    ),
    "acos": (
        _acos,
        lambda x: iv.negative(_one_over(_sqrt(iv.subtract(ONE, iv.square(x))))),
    ),
    "atan": (iv.increasing(np.arctan), lambda x: _one_over(iv.add(ONE, iv.square(x)))),
    "sinh": (_sinh, _cosh),
    "cosh": (_cosh, _sinh),
    "tanh": (_tanh, lambda x: iv.subtract(ONE, iv.square(_tanh(x)))),
    "exp": (_exp, _exp),
    "log": (iv.increasing(np.log, low=0.0), _one_over),
    "sqrt": (_sqrt, lambda x: _one_over(iv.multiply(Interval.point(2.0), _sqrt(x)))),
}
_STEPS: Final = {"sign": np.sign, "floor": np.floor, "ceil": np.ceil}


def _smooth(name: str) -> Callable[[Jet], Jet]:
    extension, derivative = _SMOOTH[name]
    return lambda a: _chain(a, extension(a.value), derivative(a.value))


def _stepped(name: str) -> Callable[[Jet], Jet]:
    extension = iv.exactly(_STEPS[name])

    def apply(a: Jet) -> Jet:
        value = extension(a.value)
        around = extension(iv.outward(*a.value))  # at a jump the function is not flat
        flat = around.low == around.high
        zero = Interval.point(np.zeros(np.shape(a.slope.low)))
        return _made(value, iv.either(flat, zero, iv.whole(a.slope.low)), a)

    return apply


def _absolute(a: Jet) -> Jet:
    sign = iv.exactly(np.sign)(iv.outward(*a.value))
    return _chain(a, iv.absolute(a.value), sign)


def _smaller(a: Jet, b: Jet) -> Jet:
    value = Interval(np.minimum(a.value.low, b.value.low), np.minimum(a.value.high, b.value.high))
    either = iv.hull(a.slope, b.slope)
    slope = iv.either(a.value.high < b.value.low, a.slope, either)
    return _made(value, iv.either(b.value.high < a.value.low, b.slope, slope), a, b)


def _larger(a: Jet, b: Jet) -> Jet:
    return -_smaller(-a, -b)


def _angle(y: Jet, x: Jet) -> Jet:
    radius = iv.add(iv.square(x.value), iv.square(y.value))
    slope = iv.subtract(iv.multiply(y.slope, x.value), iv.multiply(x.slope, y.value))
    value = iv.angle(y.value, x.value)
    cut = (x.value.low <= 0) & (y.value.low <= 0) & (y.value.high >= 0)
    slope = iv.either(cut, iv.whole(slope.low), iv.divide(slope, radius))
    return _made(value, slope, y, x)


def _power(a: Jet, b: Jet) -> Jet:
    exponent = b.value.low
    fixed = np.ndim(exponent) == 0 and exponent == b.value.high and not np.any(b.slope.low)
    if fixed and not np.any(b.slope.high):
        p = float(exponent)
        if p == 0.0:
            return Jet.constant(np.ones(np.shape(a.value.low)), len(a.slope.low))  # also NaN ** 0
        derivative = iv.multiply(Interval.point(p), iv.power(a.value, p - 1.0))
        if p == 1.0:
            derivative = Interval.point(np.ones(np.shape(a.value.low)))
        return _chain(a, iv.power(a.value, p), derivative)
    # a^b = exp(b log a), claimed only where a > 0
    general = _smooth("exp")(b * _smooth("log")(a))
    positive = a.value.low > 0
    return Jet(
        iv.either(positive, general.value, iv.whole(general.value.low)),
        iv.either(positive, general.slope, iv.whole(general.slope.low)),
    )


def _where(condition: tuple[Any, Any] | Jet, a: Jet, b: Jet) -> Jet:
    if isinstance(condition, Jet):  # a comparison of constants, folded to 0 or 1
        condition = (condition.value.low != 0, condition.value.low != 0)
    surely, possibly = condition
    value = iv.either(surely, a.value, iv.either(possibly, iv.hull(a.value, b.value), b.value))
    undecided = iv.whole(np.broadcast_arrays(a.slope.low, b.slope.low, surely)[0])
    return Jet(value, iv.either(surely, a.slope, iv.either(possibly, undecided, b.slope)))


# A comparison of jets: (it holds everywhere, it may hold somewhere).
def _less(a: Jet, b: Jet) -> tuple[Any, Any]:
    return a.value.high < b.value.low, a.value.low < b.value.high


def _less_equal(a: Jet, b: Jet) -> tuple[Any, Any]:
    return a.value.high <= b.value.low, a.value.low <= b.value.high


def _equal(a: Jet, b: Jet) -> tuple[Any, Any]:
    one = (a.value.low == a.value.high) & (b.value.low == b.value.high)
    meet = (a.value.low <= b.value.high) & (b.value.low <= a.value.high)
    return one & meet, meet


def _unequal(a: Jet, b: Jet) -> tuple[Any, Any]:
    surely, possibly = _equal(a, b)
    return ~possibly, ~surely


_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    "+": Jet.__add__, "-": Jet.__sub__, "*": Jet.__mul__, "/": Jet.__truediv__,
    "negative": Jet.__neg__, "**": _power, "abs": _absolute, "min": _smaller, "max": _larger,
    "atan2": _angle, "where": _where,
    "<": _less, "<=": _less_equal, ">": lambda a, b: _less(b, a),
    ">=": lambda a, b: _less_equal(b, a), "==": _equal, "!=": _unequal,
    **{name: _smooth(name) for name in _SMOOTH}, **{name: _stepped(name) for name in _STEPS},
}  # fmt: skip

if missing := set(FORMULA_FUNCTIONS) - set(_OPERATIONS):  # a new function needs its enclosure
    raise NotImplementedError(f"no enclosure of {sorted(missing)}")


def apply(operation: str, operands: Sequence[Any]) -> Any:
    """Apply an operation of the formula language to jets."""
    return _OPERATIONS[operation](*operands)

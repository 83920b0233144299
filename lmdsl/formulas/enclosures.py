"""Formulas on intervals with derivatives: enclosures of what is computed on a box.

F is a formula over the reals, every constant in it being the double that it is; f is the formula
as computed: the same operations in the same order, each within its error. A jet holds, on a box b,

- an interval N of values, by interval arithmetic on the very operations: it contains F(b) and f(b);
- for each of d directions an interval of derivatives (forward mode), which contains F'(b);
- a bound e of |f - F| on b, by forward error analysis in the same pass.

The mean value form M = F(c) + F'(b) (b - c) is far tighter than N where the box is small, but it
contains F(b) only: f(b) lies in M + [-e, e], and so in its intersection with N (:func:`enclosure`).
Comparisons, floor, mod and sign are decided by N alone; so f and F then take the same branch. A
function with a jump (floor, mod, sign, an undecided ``where``) gets the whole line as derivative,
so that only its range counts. Where a value may be infinite or undefined, everything made of it is
the whole line: NumPy's NaN cannot hide behind a ``max`` or a ``tanh``. A bound that is infinite or
NaN is none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from lmdsl.formulas import intervals as iv
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.operations import FORMULA_FUNCTIONS
from lmdsl.formulas.truths import COMPARED, JOINED, Truth


class Jet:
    """Values N, shape B, d derivatives, shape (d, *B), and error e, shape B; see the module.

    Arithmetic with jets and numbers works as with arrays, so that a Runge-Kutta step encloses as
    well. Shapes B that broadcast against each other have as many axes.
    """

    __array_ufunc__ = None  # a NumPy number times a jet is the jet's business

    def __init__(self, value: Interval, slope: Interval, error: Any) -> None:
        self.value, self.slope, self.error = value, slope, error

    @staticmethod
    def constant(x: Any, directions: int, axes: int = 1) -> Jet:
        """Return numbers that do not vary, one for all boxes or an array of ``axes`` axes."""
        value = Interval.point(x)
        if not np.isfinite(value.low).all():
            value = iv.outward(np.where(np.isfinite(value.low), value.low, np.nan), value.high)
        zero = np.zeros((directions, *(np.shape(x) or (1,) * axes)))
        return Jet(value, Interval.point(zero), 0.0)

    @staticmethod
    def held(value: Interval, directions: int) -> Jet:
        """Return a number of an interval, the same for all boxes; nothing is derived by it."""
        zero = np.zeros((directions, *np.atleast_1d(value.low).shape))
        return Jet(value, Interval.point(zero), 0.0)

    @staticmethod
    def variable(value: Interval, k: int, directions: int) -> Jet:
        """Return the k-th of the variables with respect to which derivatives are taken."""
        slope = np.zeros((directions, *np.shape(value.low)))
        slope[k] = 1.0
        return Jet(value, Interval.point(slope), 0.0)

    def __add__(self, other: Any) -> Jet:
        b = _jet(other, self)
        value, slope = iv.add(self.value, b.value), iv.add(self.slope, b.slope)
        return _made(value, slope, _rounded(self.error + b.error, value), self, b)

    def __sub__(self, other: Any) -> Jet:
        b = _jet(other, self)
        value, slope = iv.subtract(self.value, b.value), iv.subtract(self.slope, b.slope)
        return _made(value, slope, _rounded(self.error + b.error, value), self, b)

    def __mul__(self, other: Any) -> Jet:
        if other is self:
            return _chain(self, iv.square(self.value), iv.add(self.value, self.value))
        b = _jet(other, self)
        value = iv.multiply(self.value, b.value)
        slope = iv.add(iv.multiply(self.slope, b.value), iv.multiply(b.slope, self.value))
        error = iv.magnitude(self.value) * b.error + iv.magnitude(b.value) * self.error
        return _made(value, slope, _rounded(error, value), self, b)

    def __truediv__(self, other: Any) -> Jet:
        b = _jet(other, self)
        value = iv.divide(self.value, b.value)
        rise = iv.subtract(self.slope, iv.multiply(value, b.slope))
        error = (self.error + iv.magnitude(value) * b.error) / iv.mignitude(b.value)
        return _made(value, iv.divide(rise, b.value), _rounded(error, value), self, b)

    def __neg__(self) -> Jet:
        return Jet(iv.negative(self.value), iv.negative(self.slope), self.error)

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: Any) -> Jet:
        return _jet(other, self) - self


def enclosure(box: Jet, centre: Jet, away: Sequence[Interval]) -> Interval:
    """Return what contains all values computed on a box: N and the mean value form, intersected.

    ``centre`` is the jet at a point of the box, ``away`` the box minus that point by direction.
    """
    mean = centre.value
    for k, by in enumerate(away):
        slope = Interval(box.slope.low[k], box.slope.high[k])
        if np.any(slope.low) or np.any(slope.high):  # else the shape of this direction stays out
            mean = iv.add(mean, iv.multiply(slope, by))
    return iv.intersection(box.value, iv.outward(mean.low - box.error, mean.high + box.error))


def _jet(x: Any, like: Jet) -> Jet:
    slope = np.shape(like.slope.low)
    return x if isinstance(x, Jet) else Jet.constant(x, slope[0], len(slope) - 1)


_ROUNDED_UP: Final = 1.0 + 2.0**-47  # more than some dozen sums and products lose


def _rounded(error: Any, value: Interval, share: float = iv.ROUNDING) -> Any:
    """Return a bound of the error of a result: of its operands, and its own relative error."""
    return (error + share * iv.magnitude(value)) * _ROUNDED_UP + iv.TINY


def _made(value: Interval, slope: Interval, error: Any, *operands: Jet) -> Jet:
    """Return a result, the whole line wherever an operand or the result may not be finite."""
    sound: Any = np.isfinite(value.low) & np.isfinite(value.high)
    for a in operands:
        sound = sound & np.isfinite(a.value.low) & np.isfinite(a.value.high)
    if np.all(sound):
        return Jet(value, slope, error)
    return Jet(
        iv.either(sound, value, iv.whole(sound)),
        iv.either(sound, slope, iv.whole(sound)),
        np.where(sound, error, np.inf),
    )


def _chain(a: Jet, value: Interval, derivative: Interval, share: float = iv.ROUNDING) -> Jet:
    """Return g(a) from the values and derivatives of g and its own relative error."""
    moved = np.where(np.equal(a.error, 0.0), 0.0, iv.magnitude(derivative) * a.error)
    return _made(value, iv.multiply(a.slope, derivative), _rounded(moved, value, share), a)


def _one_over(x: Interval) -> Interval:
    return iv.divide(Interval.point(1.0), x)


ONE: Final = Interval.point(1.0)
_exp = iv.increasing(np.exp)
_sqrt = iv.increasing(np.sqrt, low=0.0)
_sinh = iv.increasing(np.sinh)
_tanh = iv.increasing(np.tanh)


def _cosh(x: Interval) -> Interval:
    return iv.even(x, np.cosh, iv.loosened)


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
        lambda x: iv.negative(iv.increasing(lambda t: -np.arccos(t), -1.0, 1.0)(x)),
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

_STEPS: Final = {"sign": np.sign, "floor": np.floor, "ceil": np.ceil, "rint": np.rint}
_FUNCTION: Final = 2 * iv.FUNCTION_ULPS * iv.ROUNDING


def _smooth(name: str) -> Callable[[Jet], Jet]:
    extension, derivative = _SMOOTH[name]
    return lambda a: _chain(a, extension(a.value), derivative(a.value), _FUNCTION)


def _stepped(name: str) -> Callable[[Jet], Jet]:
    extension = iv.exactly(_STEPS[name])

    def apply(a: Jet) -> Jet:
        value = extension(a.value)
        around = extension(iv.outward(*a.value))  # at a jump the function is not flat
        flat = around.low == around.high
        zero = Interval.point(np.zeros(np.shape(a.slope.low)))
        slope = iv.either(flat, zero, iv.whole(a.slope.low))
        return _made(value, slope, _width(value), a)

    return apply


def _width(value: Interval) -> Any:
    """Return a bound of the error that holds whatever is computed: both results lie in N."""
    return (value.high - value.low) * _ROUNDED_UP


def _absolute(a: Jet) -> Jet:
    sign = iv.exactly(np.sign)(iv.outward(*a.value))
    return _made(iv.absolute(a.value), iv.multiply(a.slope, sign), a.error, a)


def _smaller(a: Jet, b: Jet) -> Jet:
    value = Interval(np.minimum(a.value.low, b.value.low), np.minimum(a.value.high, b.value.high))
    first, second = a.value.high < b.value.low, b.value.high < a.value.low
    slope = iv.either(first, a.slope, iv.either(second, b.slope, iv.hull(a.slope, b.slope)))
    error = np.where(first, a.error, np.where(second, b.error, np.maximum(a.error, b.error)))
    return _made(value, slope, error, a, b)


def _larger(a: Jet, b: Jet) -> Jet:
    return -_smaller(-a, -b)


def _angle(y: Jet, x: Jet) -> Jet:
    radius = iv.add(iv.square(x.value), iv.square(y.value))
    slope = iv.subtract(iv.multiply(y.slope, x.value), iv.multiply(x.slope, y.value))
    value = iv.angle(y.value, x.value)
    cut = (x.value.low <= 0) & (y.value.low <= 0) & (y.value.high >= 0)
    slope = iv.either(cut, iv.whole(slope.low), iv.divide(slope, radius))
    moved = iv.magnitude(x.value) * y.error + iv.magnitude(y.value) * x.error
    error = _rounded(moved / iv.mignitude(radius), value, _FUNCTION)
    return _made(value, slope, np.where(cut, _width(value), error), y, x)


def _power(a: Jet, b: Jet) -> Jet:
    exponent = b.value.low
    if np.ndim(exponent) == 0 and exponent is b.value.high:  # a constant
        p = float(exponent)
        if p == 0.0:
            return Jet.constant(np.ones(np.shape(a.value.low)), len(a.slope.low))  # also NaN ** 0
        derivative = iv.multiply(Interval.point(p), iv.power(a.value, p - 1.0))
        if p == 1.0:
            derivative = Interval.point(np.ones(np.shape(a.value.low)))
        return _chain(a, iv.power(a.value, p), derivative, _FUNCTION)
    # a^b = exp(b log a), claimed only where a > 0
    general = _smooth("exp")(b * _smooth("log")(a))
    value = iv.loosened(*general.value)
    moved = iv.magnitude(b.value) / iv.mignitude(a.value) * a.error
    moved = moved + iv.magnitude(iv.increasing(np.log, low=0.0)(a.value)) * b.error
    error = _rounded(iv.magnitude(value) * moved, value, _FUNCTION)
    positive = a.value.low > 0
    return Jet(
        iv.either(positive, value, iv.whole(value.low)),
        iv.either(positive, general.slope, iv.whole(general.slope.low)),
        np.where(positive, error, np.inf),
    )


def _remainder(a: Jet, b: Jet) -> Jet:
    turns = iv.floors(a.value, b.value)
    value = iv.remainder(a.value, b.value, turns)
    around = iv.floors(iv.outward(*a.value), b.value)  # at a jump it has no slope
    smooth = around.low == around.high
    k = Interval(*(np.where(smooth, t, 0.0) for t in around))
    slope = iv.subtract(a.slope, iv.multiply(k, b.slope))
    slope = iv.either(smooth, slope, iv.whole(slope.low))
    moved = a.error + iv.magnitude(turns) * b.error  # the quotient's floor is exact
    error = np.where(turns.low == turns.high, _rounded(moved, value), _width(value))
    return _made(value, slope, error, a, b)


def truth(condition: Truth | Jet) -> Truth:
    """Return what is known of a condition; one of constants is folded to 0 or 1."""
    if isinstance(condition, Jet):
        holds = condition.value.low != 0
        return holds, holds
    return condition


def _compared(name: str) -> Callable[[Jet, Jet], Truth]:
    return lambda a, b: COMPARED[name](a.value, b.value)


def _joined(name: str) -> Callable[..., Truth]:
    return lambda *conditions: JOINED[name](*map(truth, conditions))


def _where(condition: Truth | Jet, a: Jet, b: Jet) -> Jet:
    surely, possibly = truth(condition)
    both = iv.hull(a.value, b.value)
    value = iv.either(surely, a.value, iv.either(possibly, both, b.value))
    undecided = iv.whole(np.broadcast_arrays(a.slope.low, b.slope.low, surely)[0])
    slope = iv.either(surely, a.slope, iv.either(possibly, undecided, b.slope))
    error = np.where(surely, a.error, np.where(possibly, _width(both), b.error))
    return Jet(value, slope, error)


_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    "+": Jet.__add__, "-": Jet.__sub__, "*": Jet.__mul__, "/": Jet.__truediv__,
    "negative": Jet.__neg__, "**": _power, "abs": _absolute, "min": _smaller, "max": _larger,
    "atan2": _angle, "where": _where, "mod": _remainder,
    **{name: _compared(name) for name in COMPARED}, **{name: _joined(name) for name in JOINED},
    **{name: _smooth(name) for name in _SMOOTH}, **{name: _stepped(name) for name in _STEPS},
}  # fmt: skip

if missing := set(FORMULA_FUNCTIONS) - set(_OPERATIONS):  # a new function needs its enclosure
    raise NotImplementedError(f"no enclosure of {sorted(missing)}")


def apply(operation: str, operands: Sequence[Any]) -> Any:
    """Apply an operation of the formula language to jets."""
    return _OPERATIONS[operation](*operands)

"""Elementary functions to 100 digits (332 bits), from the decimal module's exp, ln and sqrt."""

from __future__ import annotations

import math
from decimal import MAX_EMAX, MIN_EMIN, Context, Decimal, localcontext
from functools import cache

DIGITS = 100


def _context(digits=DIGITS + 20):
    return localcontext(Context(prec=digits, Emin=MIN_EMIN, Emax=MAX_EMAX))


@cache
def _pi():
    """Machin's formula, with digits enough to reduce the largest double."""
    with _context(480):
        return 16 * _arctan_of_inverse(5) - 4 * _arctan_of_inverse(239)


def _arctan_of_inverse(n):
    total, power, k = Decimal(0), Decimal(1) / n, 0
    while abs(power) > Decimal(10) ** -478:
        total += power / (2 * k + 1)
        power, k = -power / (n * n), k + 1
    return total


def _series(x, first, alternate):
    """x^first/first! -+ x^(first + 2)/(first + 2)! ..."""
    term, total, n = (x if first else Decimal(1)), Decimal(0), first
    while term and term.adjusted() > (total.adjusted() if total else -(10**6)) - DIGITS - 10:
        total += term
        term = term * x * x / ((n + 1) * (n + 2)) * (-1 if alternate else 1)
        n += 2
    return total


def _turn(x):
    """Return x - k pi/2, |.| <= pi/4, and k modulo 4."""
    with _context(480):
        k = (x / (_pi() / 2)).to_integral_value()
        return x - k * (_pi() / 2), int(k % 4)


def sin(x):
    r, k = _turn(x)
    return _series(+r, 1 - k % 2, True) * (-1 if k % 4 in (2, 3) else 1)


def cos(x):
    r, k = _turn(x)
    return _series(+r, k % 2, True) * (-1 if k % 4 in (1, 2) else 1)


def atan(x):
    doublings = 0
    while abs(x) > Decimal("0.05"):
        x, doublings = x / (1 + (1 + x * x).sqrt()), doublings + 1
    term, total, n = x, Decimal(0), 1
    while term and term.adjusted() > (total.adjusted() if total else -(10**6)) - DIGITS - 10:
        total, n = total + term / n, n + 2
        term = -term * x * x
    return total * 2**doublings


def atan2(y, x):
    pi = +_pi()
    if x > 0:
        return atan(y / x)
    if x == 0:
        return (pi / 2).copy_sign(y) if y else Decimal(0)
    return atan(y / x) + (pi if y >= 0 else -pi)


def asin(x):
    return (+_pi() / 2).copy_sign(x) if abs(x) == 1 else atan(x / ((1 - x) * (1 + x)).sqrt())


def acos(x):
    return +_pi() if x == -1 else 2 * atan(((1 - x) / (1 + x)).sqrt())


def sinh(x):
    return _series(x, 1, False) if abs(x) < 1 else (x.exp() - (-x).exp()) / 2


def cosh(x):
    return (x.exp() + (-x).exp()) / 2


def tanh(x):
    return sinh(x) / cosh(x) if abs(x) < 200 else Decimal(1).copy_sign(x)


def power(a, b):
    return Decimal(1) if b == 0 else (b * a.ln()).exp()


FUNCTIONS = {
    "sin": sin, "cos": cos, "tan": lambda x: sin(x) / cos(x), "asin": asin, "acos": acos,
    "atan": atan, "sinh": sinh, "cosh": cosh, "tanh": tanh, "exp": Decimal.exp, "log": Decimal.ln,
    "sqrt": Decimal.sqrt, "atan2": atan2, "**": power,
}  # fmt: skip


def exact(name, *arguments):
    """Return the value of a function of doubles."""
    with _context():
        return FUNCTIONS[name](*(Decimal(float(x)) for x in arguments))


def ulps(computed, value):
    """Return by how many units in the last place of a value a double misses it."""
    with _context():
        return float(abs(Decimal(float(computed)) - value) / Decimal(math.ulp(float(value))))

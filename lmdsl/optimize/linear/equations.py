"""Solving x = b + M x for a nonnegative sparse M: the evaluation of a fixed policy.

For b >= 0 the smallest nonnegative solution is sum M^k b, finite for every b exactly when the
spectral radius of M is below 1. The cells outside the core, most of them as a rule, are solved by
substitution. On the core Gauss-Seidel sweeps converge, from any x >= 0, at least as
fast as Jacobi's, and keep every iterate >= 0. Where they converge slowly and cells are many, a
Krylov method makes a better guess. Where that does not help the system is solved directly, class by
class: the strongly connected classes of M are visited in an order in which
everything a class leads to is known, single cells by substitution, larger classes by sparse LU.
Values may then span hundreds of decades, as a chain of slow classes makes them do, and each class
is still solved to its own precision. Whether an answer is good enough is judged by the certificate.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from lmdsl.common.types import Bools, Floats, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.optimize.linear import extrapolation
from lmdsl.optimize.linear.classes import _spread, solve_by_class
from lmdsl.optimize.linear.gauss_seidel import CEILING, NEVER, TOLERANCE, SplitMatrix
from lmdsl.optimize.linear.substitution import Peeled

TRIAL_SWEEPS = 60  # number of sweeps after which it is asked how fast they converge
MAX_SWEEPS = 200_000  # number of sweeps above which they are given up
# Number of components from which on Krylov steps are made; of steps, and of sweeps in them, two
# cycles each, above which they end.
KRYLOV, KRYLOV_STEPS, KRYLOV_SWEEPS = 1000, 200, 1600
# Number of sweeps to go above which Krylov steps, and a sparse factorisation, are tried first.
FEW_SWEEPS, MANY_SWEEPS = 100, 300
PER_CORE = 20  # number of sweeps of the core for one of all cells above which all are swept again


def solve(M: Any, b: Floats, time_up: TimeUp = never) -> Floats | None:
    """Return x >= 0 with x = b + M x, or None where there is none (as far as rounding can tell).

    M is a CSR array (n, n), b has shape (n,), all entries >= 0; ``time_up`` as in
    :func:`solve_from`.
    """
    x = np.array(b, dtype=np.float64)
    peeled = Peeled.of(SplitMatrix.of(M))
    return x if solve_from(peeled, b, x, lambda: M, time_up) else None


def solve_from(
    peeled: Peeled,
    b: Floats,
    x: Floats,
    matrix: Callable[[], Any],
    time_up: TimeUp = never,
) -> bool:
    """Solve in place from a guess; ``matrix`` makes M, as a CSR array, where sweeps are slow.

    ``time_up``, asked after the first few sweeps, then between sweeps and classes, ends the work
    with Stopped.
    """
    core, inner = peeled.core, peeled.inner
    whole = inner is peeled.system

    def part() -> Any:
        return matrix() if whole else matrix()[core][:, core]

    guess, c = (x, b) if whole else (x[core], b[core])
    y = _solve(inner, c, guess, part, 0.0, time_up)
    if y is None:
        return False
    x[core] = y
    return peeled.substitute(b, x)


def solve_transposed(
    peeled: Peeled,
    b: Floats,
    matrix: Callable[[], Any],
    start: Floats | None = None,
    flat: float = 0.0,
    time_up: TimeUp = never,
) -> Floats | None:
    """Return x >= 0 with x = b + M'x, or None; parameters as in :func:`solve_from`.

    A sweep that moves no component by more than ``flat`` ends the work as well.
    """
    x, core = b.copy(), peeled.core
    if not peeled.flow(x):
        return None
    inner = peeled.inner.transposed()

    def part() -> Any:
        return matrix()[core][:, core].T.tocsr()

    c = x[core]
    y = _solve(inner, c, c.copy() if start is None else start[core], part, flat, time_up)
    if y is None:
        return None
    x[core] = y
    return x


def advance(peeled: Peeled, b: Floats, x: Floats, count: int, enough: float, flat: float) -> float:
    """Come closer to x = b + M x in place, by about the work of ``count`` sweeps.

    From x >= b + M x it lowers x, from below it raises it, as sweeps do. A small core is swept to
    the end where that is not too much work, then substituted from; where it is not small, all cells
    are swept until the largest relative change is ``enough`` or no component moves by more than
    ``flat``. Returns the largest relative change of the last sweep, at most ``TOLERANCE`` where x
    is the solution; infinite where there is none in sight.
    """
    if not peeled.small:
        return peeled.system.sweep(b, x, count, enough, flat)[1]
    change = 0.0
    if len(peeled.core):
        y = x[peeled.core]
        count *= min(len(x) // len(y), PER_CORE)
        change = peeled.inner.sweep(b[peeled.core], y, count, TOLERANCE)[1]
        if not change < np.inf:
            return np.inf
        x[peeled.core] = y
    return change if peeled.substitute(b, x) else np.inf


def descend(peeled: Peeled, b: Floats, x: Floats, enough: float, time_up: TimeUp = never) -> bool:
    """Lower x >= b + M x in place, b > 0, by a Krylov method; False where that fails.

    Its y is close to the solution, not above b + M y. With r = b + M y - y and t >= max(r / b),
    y + t x is: (I - M)(y + t x) >= b - r + t b.
    """
    whole = not peeled.small
    system, c = (peeled.system, b) if whole else (peeled.inner, b[peeled.core])
    v = x if whole else x[peeled.core]
    if len(v):
        y = _krylov(system, c, v, time_up, max(enough, 1e-13))
        if y is None:
            return False
        system.sweep(c, y, len(system.directions.cycle))
        share = float((system.residual(c, y) / (system.inverse * c)).max(initial=0.0))
        y += share * (1 + 1e-9) * v
        if not (y < CEILING).all():
            return False
        np.minimum(v, y, out=v)
        if not whole:
            x[peeled.core] = v
    return whole or peeled.substitute(b, x)


def lift(peeled: Peeled, b: Floats, x: Floats) -> bool:
    """Raise x in place to x >= b + M x, along the slowest mode; False where that fails.

    It is the mode of the core where that is small, else of all cells.
    """
    if not peeled.small:
        return extrapolation.lift(peeled.system, b, x)
    y = x[peeled.core]
    if not extrapolation.lift(peeled.inner, b[peeled.core], y):
        return False
    x[peeled.core] = y
    return peeled.substitute(b, x)


def _solve(
    system: SplitMatrix,
    b: Floats,
    x: Floats,
    matrix: Callable[[], Any],
    flat: float,
    time_up: TimeUp,
) -> Floats | None:
    """Solve from a guess, which is overwritten, by sweeps or class by class."""
    nothing = ~_positive(system, b) if (b == 0).any() else None
    if nothing is not None:
        x[nothing] = 0.0  # exactly: a guess would only decay there
    change, rate = _trial(system, b, x, flat)
    if change <= TOLERANCE:
        return x
    guess = None
    if len(b) >= KRYLOV and not _soon(change, rate, FEW_SWEEPS):
        guess = _krylov(system, b, x, time_up)
    if guess is not None:
        x = guess
        if nothing is not None:
            x[nothing] = 0.0
        change, rate = _trial(system, b, x, flat)
        if change <= TOLERANCE:
            return x
    if not _soon(change, rate, MANY_SWEEPS):
        direct, small_enough = solve_by_class(matrix(), b, time_up)
        if direct is not None or small_enough:
            return direct
    for _ in range(MAX_SWEEPS // TRIAL_SWEEPS):
        if time_up():
            raise Stopped
        change, rate = _trial(system, b, x, flat)
        if change <= TOLERANCE:
            return x
        if not np.isfinite(change) or x.max() > CEILING:
            return None
    return None


def guess(system: SplitMatrix, b: Floats, time_up: TimeUp = never) -> Floats | None:
    """Return x close to b + M x by a Krylov method and sweeps alone; None where it breaks down."""
    x = _krylov(system, b, b.copy(), time_up)
    if x is not None:
        system.sweep(b, x, TRIAL_SWEEPS // 3)
    return x


def _krylov(
    system: SplitMatrix, b: Floats, x: Floats, time_up: TimeUp, enough: float = 1e-13
) -> Floats | None:
    """Return a better guess by BiCGSTAB (van der Vorst 1992), None where it breaks down.

    A cycle of sweeps in all directions maps x to S x + s; it solves x - S x = s, in one step for
    each mode that hinders sweeps, such as the slow escape from a well-mixed set. A solution >= 0 is
    the right one: the left Perron vector of a class with spectral radius 1
    or more contradicts x >= b + M x > 0 there. SciPy's breaks down at absolute sizes, and its sums
    depend on the number of BLAS threads.
    """
    count, zero = len(system.directions.cycle), np.zeros(len(b))

    def swept(c: Floats, v: Floats) -> Floats:
        v = v.copy()
        system.sweep(c, v, count, enough=-1.0, flat=-1.0)
        return v

    if system.inverse.max() >= NEVER:
        return None
    with np.errstate(all="ignore"):
        unit = float((system.inverse * b).max())
        if not 0 < unit < CEILING:
            return None
        known, steps = swept(b / unit, zero), min(KRYLOV_STEPS, KRYLOV_SWEEPS // (2 * count))
        y = extrapolation.bicgstab(
            lambda v: v - swept(zero, v), known, x / unit, steps, time_up, enough
        )
        guess = np.maximum(unit * y, b)
    if not (guess < CEILING).all() or y.min() < -1e-9 * y.max():
        return None
    return guess


def _positive(system: SplitMatrix, b: Floats) -> Bools:
    """Return where x > 0: the cells from which some b > 0 can be reached."""
    positive, before = b > 0, system.transposed()
    _spread(before.begin, before.end, before.indices, positive)
    return positive


def _soon(change: float, rate: float, sweeps: int) -> bool:
    """Return whether so many sweeps more should suffice."""
    if not (change < np.inf and rate < 1):
        return False
    return bool(np.log(TOLERANCE / change) / np.log(max(rate, 1e-300)) < sweeps)


def _trial(system: SplitMatrix, b: Floats, x: Floats, flat: float) -> tuple[float, float]:
    """Sweep; return the last relative change, and the factor by which a sweep shrinks it."""
    halfway, last = system.sweep(b, x, TRIAL_SWEEPS, TOLERANCE, flat)
    rate = (last / halfway) ** (2 / TRIAL_SWEEPS) if 0 < halfway < np.inf else 0.0
    return last, rate

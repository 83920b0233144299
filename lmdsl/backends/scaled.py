"""The LP as foreign solvers see it: numbers near one, and the way back.

min c'x  s.t.  A x = b, x >= 0  with c = G / max G and b = m / max m. Solvers test absolute
tolerances; costs of 1e-9 or 1e9, or a million cells of weight 1e-6, must not decide what passes.
Back: V = max G * y with y the multiplier of A x = b, and theta = max m * x.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from traceback import walk_tb
from typing import TYPE_CHECKING, Any

import numpy as np

from lmdsl.backends.base import Options, Solution, Stop
from lmdsl.common.types import Floats
from lmdsl.errors import plain_text
from lmdsl.machine import apart, memory
from lmdsl.machine.deadline import Deadline, TimeLimitReached

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP


ENTRY = 100  # bytes of an entry of the matrix: SciPy's while it is made, and the copy of a solver


@dataclass(frozen=True, eq=False)
class ScaledLP:
    """The scaled LP; its arrays are copies, so that no solver can touch the model's."""

    A: Any  # (E - gamma P)', SciPy CSC, shape (n, K)
    # b, c: right-hand side, shape (n,), and cost, shape (K,); largest entry 1, or all zero
    b: Floats
    c: Floats
    # b_unit, c_unit: what 1 stands for in b and in c
    b_unit: float
    c_unit: float
    started: float = field(default_factory=time.monotonic)  # when work on it began

    @classmethod
    def of(cls, lp: StabilizationLP) -> ScaledLP:
        """Scale the LP with weight ``lp.solve_weight``.

        MemoryError where it does not fit; how much a solver takes beside it is not known.
        """
        needed = ENTRY * (len(lp.rows.target) + 2 * lp.K)
        if not memory.fits(needed):
            raise MemoryError(f"the linear program needs about {memory.human(needed)}")
        started = time.monotonic()
        weight = lp.solve_weight
        b_unit, c_unit = _unit(weight), _unit(lp.cost)
        return cls(lp.A, weight / b_unit, lp.cost / c_unit, b_unit, c_unit, started)

    def seconds_left(self, limit: float | None) -> float | None:
        """Return what building the LP has left of a time limit."""
        return None if limit is None else max(limit - (time.monotonic() - self.started), 0.0)

    def time_up(self, limit: float | None) -> bool:
        """Return whether a time limit has passed."""
        return self.seconds_left(limit) == 0.0

    def out_of_time(self) -> Solution:
        """Return the solution where building the LP has used up the time: solvers may not look."""
        return Solution(Stop.TIME_LIMIT, "time limit reached before the solver started")

    def solved(self, native: Callable[[ScaledLP, Options], Solution], options: Options) -> Solution:
        """Ask a solver, in a process of its own where it might not end in time (apart.py).

        ``native`` is a function of a module that imports no more than the solver.
        """
        limit = options.time_limit
        if self.time_up(limit):
            return self.out_of_time()
        plain = replace(options, start=None, proof=None, progress=None)
        deadline = Deadline(self.seconds_left(limit))
        try:
            return apart.call(
                native, self, plain, deadline=deadline, doing="solving", entries=self.A.nnz
            )
        except TimeLimitReached:
            return Solution(Stop.TIME_LIMIT, "ended at the time limit")
        except apart.Ended as error:
            return Solution(Stop.FAILED, str(error))

    def solution(
        self,
        stop: Stop,
        word: str,
        y: Any,
        x: Any,
        iterations: int | None,
        details: Mapping[str, Any] | None = None,
    ) -> Solution:
        """Return what a solver found, in the units of the model; other parameters as in Solution.

        y are the multipliers of A x = b with the sign of V; y and x are None where there are none,
        and dropped where not finite, where they are a ray, and where no iteration made them.
        """
        ray = stop in (Stop.INFEASIBLE, Stop.UNBOUNDED)
        if ray or not (stop.success or iterations):
            y = x = None
        value = _finite(y, len(self.b), self.c_unit)
        occupation = _finite(x, len(self.c), self.b_unit)
        return Solution(stop, word, value, occupation, None, iterations, details or {})


def failure(error: BaseException) -> Solution:
    """Return the solution that stands for a solver's exception.

    Only Ctrl-C, and what a signal handler of the program raises, goes through. Panics of solvers
    written in Rust derive from BaseException alone, and a solver that exits must not end the
    program that asked it.
    """
    if isinstance(error, KeyboardInterrupt) or _by_signal(error):
        raise error
    return Solution(Stop.FAILED, plain_text(f"{type(error).__name__}: {plain_text(error)}"))


def _by_signal(error: BaseException) -> bool:
    """Return whether an exception comes out of a Python function that handles a signal."""
    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    codes = {getattr(handler, "__code__", None) for handler in handlers}
    return any(frame.f_code in codes for frame, _ in walk_tb(error.__traceback__))


def _unit(values: Floats) -> float:
    top = float(values.max(initial=0.0))
    return top if top > 0 else 1.0


def _finite(values: Any, count: int, unit: float) -> Floats | None:
    if values is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.asarray(values, dtype=np.float64).reshape(-1) * unit
    return array if len(array) == count and np.isfinite(array).all() else None

"""Accurate integration of many runs of a differential equation, each with steps of its own.

The eighth-order method of Dormand and Prince (DOP853, with the coefficients of SciPy) keeps the
local error of every run below 1e-9 of its state and of a cell. It needs derivatives without kinks:
where formulas have these, fixed steps of the classical method are made, many more than declared.

E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, section II.5.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.formulas.program import Program
from lmdsl.machine.kernels import fixed, kernel
from lmdsl.systems.runge_kutta import RungeKutta

TOLERANCE = 1e-9
FINER, MOST_STEPS = 16, 16_000  # fixed steps: as many for each declared one; in all
ATTEMPTS = 20_000  # steps of a run above which it is given up
SHORTEST = 1e-12  # length of a step, in parts of the sampling time, below which that holds too
CHUNK = 8192  # runs integrated at a time

KINKS = frozenset({"where", "abs", "sign", "floor", "ceil", "min", "max", "mod"})


def has_kinks(field: Program, states: Sequence[str]) -> bool:
    """Return whether derivatives may jump, or bend sharply, as the states move."""
    moving = {slot for name, slot in field.variables.items() if name in states}
    for instruction in field.instructions:
        if moving.intersection(instruction.operands):
            moving.add(instruction.target)
            chosen = instruction.operands[:1] if instruction.operation == "where" else ()
            if instruction.operation in KINKS and (not chosen or moving.intersection(chosen)):
                return True
    return False


class Arc:
    """What one step of the method made of some runs.

    Attributes
    ----------
    rows
        Which runs, shape (r,).
    time, length
        Since the start, shape (r,).
    start, end
        States, and integrals after them, shape (n, r).
    steep
        Their largest speed at the stages times the length, shape (n, r).
    """

    def __init__(
        self,
        rows: Indices,
        time: Floats,
        length: Floats,
        ends: tuple[Floats, Floats],
        stages: Floats,
        more: Callable[[Bools], Floats] | None,
    ) -> None:
        self.rows, self.time, self.length = rows, time, length
        self.start, self.end = ends
        self._stages, self._more = stages, more
        self.steep = length * np.abs(stages).max(axis=0)

    def bends(self, wanted: Bools) -> Floats:
        """Return the coefficients of the paths of some rows, shape (k, n, r); see :func:`place`."""
        length, stages = self.length[wanted], self._stages[:, :, wanted]
        rise = self.end[:, wanted] - self.start[:, wanted]
        first, last = length * stages[0], length * stages[-1]
        found = np.stack([rise, first - rise, 2 * rise - (first + last)])
        if self._more is None:
            return found
        return np.concatenate([found, self._more(wanted)])


@kernel
def place(start, bends, k, i, t):  # type: ignore[no-untyped-def]
    """Return component k of run i at time t, 0 to 1: start + t (b0 + (1 - t) (b1 + t (b2 ...)))."""
    y = 0.0
    for j in range(len(bends) - 1, -1, -1):
        y = (y + bends[j, k, i]) * (t if j % 2 == 0 else 1.0 - t)
    return start[k, i] + y


@kernel
def places(start, bends, t, found):  # type: ignore[no-untyped-def]
    """Fill in where runs are at times of their arcs, shape (n, r)."""
    for k in range(found.shape[0]):
        for i in range(found.shape[1]):
            found[k, i] = place(start, bends, k, i, t[i])


@kernel
def _combine(stages, weights, h, start, found):  # type: ignore[no-untyped-def]
    """Fill in start + h times the weighted sum of stages, always in the same order."""
    for k in range(found.shape[0]):
        for i in range(found.shape[1]):
            found[k, i] = 0.0
        for s in range(len(weights)):
            if weights[s] != 0.0:
                for i in range(found.shape[1]):
                    found[k, i] += weights[s] * stages[s, k, i]
        for i in range(found.shape[1]):
            found[k, i] = start[k, i] + h[i] * found[k, i]


def _sum(stages: Floats, weights: Floats, h: Floats, start: Floats | None = None) -> Floats:
    shape = stages.shape[1:]
    found = np.empty(shape)
    start = np.zeros(shape) if start is None else start
    _combine(fixed(stages), fixed(weights), fixed(h), fixed(start), found)
    return found


@cache
def _table() -> Any:
    """Return the coefficients: stages, their times, the solution, errors, dense output."""
    from scipy.integrate import DOP853 as method  # noqa: N811

    return SimpleNamespace(
        A=np.ascontiguousarray(method.A), B=np.ascontiguousarray(method.B),
        fifth=np.ascontiguousarray(method.E5), third=np.ascontiguousarray(method.E3),
        extra=np.ascontiguousarray(method.A_EXTRA), dense=np.ascontiguousarray(method.D),
    )  # fmt: skip


Watch = Callable[[Arc], Bools]


class AccurateFlow:
    """Follows runs of an equation along a sampling time, controls and noise held.

    Parameters
    ----------
    flow
        The equation, and what is integrated along with it.
    width
        Cell widths, the unit of errors, shape (d,).
    attempts
        Steps of a run above which it is given up.
    """

    def __init__(self, flow: RungeKutta, width: Floats, attempts: int = ATTEMPTS) -> None:
        self.flow, self.width, self.attempts = flow, width, attempts
        self.smooth = not has_kinks(flow.field, flow.states)
        self.outputs = len(flow.field.formulas)
        self.step = flow.h * flow.substeps
        self.fixed_steps = min(FINER * flow.substeps, MOST_STEPS)

    @property
    def method(self) -> str:
        """How it is done, in words."""
        if self.smooth:
            return f"DOP853, errors controlled per run, tolerance {TOLERANCE:g}"
        return f"{self.fixed_steps} fixed Runge-Kutta steps per sampling time (formulas with kinks)"

    def __call__(
        self, values: Mapping[str, Floats], guard: Guard | None = None, watch: Watch | None = None
    ) -> Floats:
        """Return where runs end, and integrals, shape (n, r).

        NaN where nothing integrates them; infinite where they are given up.

        ``values`` are arrays of shape (r,). ``watch`` is told every arc of every run and returns
        which of its rows go no further; what is returned of these is where the arc ends.
        """
        state = np.zeros((self.outputs, len(values[self.flow.states[0]])))
        for k, name in enumerate(self.flow.states):
            state[k] = values[name]
        end = np.full_like(state, np.nan)
        follow = self._adaptive if self.smooth else self._fixed
        with np.errstate(all="ignore"):
            for first in range(0, state.shape[1], CHUNK):
                rows = np.arange(first, min(first + CHUNK, state.shape[1]))
                held = {name: array[rows] for name, array in values.items()}
                follow(_Runs(self, held, state[:, rows], rows, guard), end, watch)
        return end

    def _fixed(self, runs: "_Runs", end: Floats, watch: Watch | None) -> None:
        """Make equal steps of the classical method."""
        h = self.step / self.fixed_steps
        slope = runs.slope(runs.state)
        for step in range(self.fixed_steps):
            x, length = runs.state, np.full(len(runs.rows), h)
            k2 = runs.slope(x + h / 2 * slope)
            k3 = runs.slope(x + h / 2 * k2)
            k4 = runs.slope(x + h * k3)
            new = x + h / 6 * (slope + 2 * k2 + 2 * k3 + k4)
            stages = np.stack([slope, k2, k3, k4, runs.slope(new)])
            arc = Arc(runs.rows, h * step + 0 * length, length, (x, new), stages, None)
            end[:, runs.rows] = new
            on = ~watch(arc) if watch is not None else np.ones(len(length), dtype=np.bool_)
            runs.state, slope = new, stages[-1]
            if not on.all():
                runs.keep(on)
                slope = slope[:, on]
            if not len(runs.rows):
                return

    def _adaptive(self, runs: "_Runs", end: Floats, watch: Watch | None) -> None:
        """Make steps of DOP853, their lengths chosen for every run."""
        table = _table()
        slope, time = runs.slope(runs.state), np.zeros(len(runs.rows))
        h = np.full(len(runs.rows), self.step)
        for _ in range(self.attempts):
            last = h >= self.step - time
            length = np.where(last, self.step - time, h)
            stages = np.empty((13, *runs.state.shape))
            stages[0] = slope
            for s in range(1, 12):
                stages[s] = runs.slope(_sum(stages[:s], table.A[s, :s], length, runs.state))
            new = _sum(stages[:12], table.B, length, runs.state)
            stages[12] = runs.slope(new)
            error = self._error(runs.state, new, stages, length)
            fits = error <= 1
            factor = np.where(np.isfinite(error), 0.9 * np.maximum(error, 1e-16) ** -0.125, 0.2)
            h = length * np.clip(factor, 0.2, 10.0)
            ended = fits & last
            end[:, runs.rows[ended]] = new[:, ended]
            if watch is not None and fits.any():
                told = np.flatnonzero(fits)
                stopped = watch(self._arc(runs, told, time, length, new, stages))
                end[:, runs.rows[told[stopped]]] = new[:, told[stopped]]
                ended[told[stopped]] = True
            runs.state = np.where(fits, new, runs.state)
            slope = np.where(fits, stages[12], slope)
            time = np.where(fits, time + length, time)
            on = ~ended & (h >= SHORTEST * self.step)
            if not on.all():
                runs.keep(on)
                slope, time, h = slope[:, on], time[on], h[on]
            if not len(runs.rows):
                return
        end[:, runs.rows] = np.inf

    def _arc(
        self,
        runs: "_Runs",
        told: Indices,
        time: Floats,
        length: Floats,
        new: Floats,
        stages: Floats,
    ) -> Arc:
        table, h = _table(), length[told]
        start, mine = runs.state[:, told], stages[:, :, told]

        def more(wanted: Bools) -> Floats:
            rows, some = told[wanted], np.empty((16, len(new), int(wanted.sum())))
            some[:13] = mine[:, :, wanted]
            for s in range(3):
                weights = table.extra[s, : 13 + s]
                at = _sum(some[: 13 + s], weights, h[wanted], start[:, wanted])
                some[13 + s] = runs.slope(at, rows)
            return np.stack([_sum(some, weights, h[wanted]) for weights in table.dense])

        return Arc(runs.rows[told], time[told], h, (start, new[:, told]), mine, more)

    def _error(self, old: Floats, new: Floats, stages: Floats, length: Floats) -> Floats:
        """Return the estimated error of a step in parts of what is tolerated, shape (r,)."""
        table, d = _table(), len(self.width)
        scale = np.maximum(np.abs(old), np.abs(new))
        scale[:d] += self.width[:, None]
        scale[d:] += self.step * np.abs(stages[:, d:]).max(axis=0) + np.finfo(float).tiny
        one = np.ones_like(length)
        fifth, third = (
            np.square(_sum(stages, weights, one) / (TOLERANCE * scale)).sum(axis=0)
            for weights in (table.fifth, table.third)
        )
        error = length * fifth / np.sqrt((fifth + 0.01 * third) * len(new))
        return np.where((fifth == 0) & (third == 0), 0.0, error)


class _Runs:
    """The runs that are underway: which, where, and what is held meanwhile."""

    def __init__(
        self,
        flow: AccurateFlow,
        held: dict[str, Floats],
        state: Floats,
        rows: Indices,
        guard: Guard | None,
    ) -> None:
        self.flow, self.held, self.state, self.rows, self.guard = flow, held, state, rows, guard

    def slope(self, at: Floats, rows: Indices | None = None) -> Floats:
        """Return derivatives, shape (n, r)."""
        held = self.held if rows is None else {name: x[rows] for name, x in self.held.items()}
        named = zip(self.flow.flow.states, at, strict=False)
        found = self.flow.flow.field({**held, **dict(named)}, self.guard)
        slope = np.empty((len(found), at.shape[1]))
        for k, line in enumerate(found):
            slope[k] = line
        return slope

    def keep(self, on: Bools) -> None:
        """Forget the others."""
        self.held = {name: array[on] for name, array in self.held.items()}
        self.state, self.rows = np.ascontiguousarray(self.state[:, on]), self.rows[on]

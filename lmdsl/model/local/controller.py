"""The local controller C0: feedback on the attractor cells.

The controller of the LP, C1, brings every cell to the attractor A and says nothing inside. C0 is
constant, linear or LQR feedback around a fixed point or a periodic orbit x_0, x_1, ...; each
attractor cell belongs to the orbit point nearest to its centre. Controls are clipped to the range
of the control grid. Together they are the paper's feedback: C0 near the attractor, C1 outside.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np

from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model.discretization import control_range
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import linearisation, riccati
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.local_control import (
    ConstantControl,
    HoldControl,
    LinearFeedback,
    LqrFeedback,
)
from lmdsl.problem.problem import Problem

MAX_RICCATI = 256  # number of its states (orbit points x axes) above which no LQR is computed
PART = 2**12  # number of states compared with all points of an orbit at a time


def _on_arrays(operation: str, *operands: Any) -> Any:
    return {"rint": np.rint, "min": np.minimum, "max": np.maximum}[operation](*operands)


@dataclass(frozen=True, eq=False)
class LocalController(Frozen):
    """u = clip(u_k - K_k (x - x_k)), k the orbit point that owns the cell of x.

    Attributes
    ----------
    partition, attractor
        The cells, and which of them it controls, shape (N,).
    orbit
        Shape (q, d): the points x_k; the centre of the box for constant control.
    control
        Shape (q, p): the controls u_k along the orbit.
    gain
        Shape (q, p, d): the feedback matrices K_k.
    low, high
        Shape (p,): the range of the control grid, to which controls are clipped.
    multiplier
        Largest modulus of the multipliers of the linearised orbit under feedback (eigenvalues of
        the product of A_k - B_k K_k): below 1, the orbit attracts what is near. None for constant
        control, which names no orbit, and where the system is not differentiable.
    """

    partition: Partition
    attractor: Bools
    orbit: Floats
    control: Floats
    gain: Floats
    low: Floats
    high: Floats
    multiplier: float | None

    @classmethod
    def of(
        cls,
        problem: Problem,
        partition: Partition,
        attractor: Bools,
        deadline: Deadline | None = None,
    ) -> Self | None:
        """Return the feedback of a problem around an orbit, None where it names none.

        Raises
        ------
        TimeLimitReached
            The deadline has passed.
        BadInput
            The points are no orbit, lie outside the attractor, a control lies outside its range,
            or the Riccati equation has no stabilizing solution.
        """
        declared = problem.local_controller
        if declared is None or isinstance(declared, HoldControl):
            return None
        low, high = control_range(problem)
        if isinstance(declared, ConstantControl):
            orbit = (partition.low + partition.high)[None, :] / 2
        else:
            orbit = linearisation.points(declared.orbit, partition)
        control = np.zeros((len(orbit), len(low)))
        for j, name in enumerate(problem.controls):
            control[:, j] = declared.control.get(name, 0.0)
        _within(control, low, high, problem.controls)
        gain, multiplier = np.zeros((*control.shape, partition.dimension)), None
        if not isinstance(declared, ConstantControl):
            _inside(orbit, partition, attractor)
            guard = partial(Deadline.of(deadline).raise_if_over, "linearising along the orbit")
            reach = linearisation.reach(low, high, control)
            true_map = TrueMap(problem, partition)
            A, B = linearisation.along(true_map, orbit, control, reach, guard)
            gain = _gain(declared, problem, A, B, partition.width, reach)
            multiplier = _multiplier(A, B, gain / reach[:, None] * partition.width)
        return cls(partition, attractor, orbit, control, gain, low, high, multiplier)

    def owner(self, cell: Indices) -> Indices:
        """Return the index of the orbit point nearest to the centre of each cell."""
        if len(self.orbit) == 1:
            return np.zeros(len(cell), dtype=np.int64)
        nearest = np.empty(len(cell), dtype=np.int64)
        for start in range(0, len(cell), PART):
            some = slice(start, start + PART)
            centres = self.partition.centres(cell[some])
            away = self.partition.deviation(centres[:, None, :], self.orbit[None, :, :])
            far: Any = sum((away[..., i] / h) ** 2 for i, h in enumerate(self.partition.width))
            nearest[some] = np.argmin(far, axis=-1)
        return nearest

    def __call__(self, x: Floats, cell: Indices) -> Floats:
        """Return the control at states x, shape (r, d), of given attractor cells, shape (r, p)."""
        u = self.law(list(x.T), cell)
        return np.stack(u, axis=-1) if u else np.zeros((len(x), 0))

    def law(
        self, x: Sequence[Any], cell: Indices, apply: Callable[..., Any] = _on_arrays
    ) -> list[Any]:
        """Return the controls at states given by axis, arrays or anything else with arithmetic.

        ``apply(name, *operands)`` does the operations ``rint``, ``min`` and ``max``. The order of
        all operations is fixed, so that an enclosure of them holds for what is computed.
        """
        k = self.owner(cell)
        # By way of the cell's centre: on a circle the law then has no jump inside a cell.
        centre = self.partition.centres(cell)
        origin = self.partition.deviation(centre, self.orbit[k])
        away = []
        for i, axis in enumerate(self.partition.axes):
            by = x[i] - centre[:, i]
            if axis.periodic:
                span = axis.high - axis.low
                by = by - apply("rint", by / span) * span
            away.append(by + origin[:, i])
        controls = []
        for j in range(self.gain.shape[1]):
            u: Any = self.control[k, j]
            for i, by in enumerate(away):
                if self.gain[:, j, i].any():
                    u = u - self.gain[k, j, i] * by
            u = apply("max", u, self.low[j])
            controls.append(apply("min", u, self.high[j]))
        return controls

    def distance(self, x: Floats) -> Floats:
        """Return the distance from the orbit in cell widths (largest axis), shape (r,)."""
        distance = np.empty(len(x))
        for start in range(0, len(x), PART):
            some = slice(start, start + PART)
            away = self.partition.deviation(x[some, None, :], self.orbit[None, :, :])
            distance[some] = np.abs(away / self.partition.width).max(axis=-1).min(axis=-1)
        return distance


def _within(control: Floats, low: Floats, high: Floats, names: tuple[str, ...]) -> None:
    for j, name in enumerate(names):
        for u in control[:, j]:
            if not low[j] <= u <= high[j]:
                raise BadInput(
                    f"{float(u)!r} is outside the control grid "
                    f"[{float(low[j])!r}, {float(high[j])!r}]",
                    f"local_controller.control.{name}",
                )


def _inside(orbit: Floats, partition: Partition, attractor: Bools) -> None:
    for k, point in enumerate(orbit):
        where = f"local_controller.orbit[{k}]"
        block = partition.around_point([float(x) for x in point], where)
        cells = np.ravel_multi_index(np.ix_(*block), partition.shape)
        if not attractor[np.sort(cells, axis=None)].any():
            raise BadInput("the point lies in no attractor cell; add it to the attractor", where)


def _gain(
    declared: LinearFeedback | LqrFeedback,
    problem: Problem,
    A: Floats,
    B: Floats,
    width: Floats,
    reach: Floats,
) -> Floats:
    """Return the feedback matrices, shape (q, p, d)."""
    if isinstance(declared, LqrFeedback):
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise BadInput("the system is not differentiable there", "local_controller.orbit")
        return _regulator(A, B, declared, problem, width, reach) * reach[:, None] / width
    gain = np.zeros((len(A), len(reach), len(width)))
    for j, u in enumerate(problem.controls):
        for i, x in enumerate(problem.states):
            gain[:, j, i] = declared.gain.get(u, {}).get(x, 0.0)
    return gain


def _multiplier(A: Floats, B: Floats, gain: Floats) -> float | None:
    """Return the largest modulus of the multipliers, all in the units of A and B."""
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        return None
    product = np.eye(A.shape[1])
    for k in range(len(A)):
        product = (A[k] - B[k] @ gain[k]) @ product
    return float(np.abs(np.linalg.eigvals(product)).max())


def _regulator(
    A: Floats, B: Floats, declared: LqrFeedback, problem: Problem, width: Floats, reach: Floats
) -> Floats:
    """Return the gains of the regulator for A, B in units of cell widths and reach of controls."""
    q, d, p = B.shape
    where = "local_controller"
    if q * d > MAX_RICCATI:
        raise BadInput(f"{q} points of {d} axes; at most {MAX_RICCATI} in all", f"{where}.orbit")
    if not p:
        return np.zeros((q, 0, d))
    weights = (
        np.array([_scaled(given, name, float(by)) for name, by in zip(names, unit, strict=True)])
        for given, names, unit in (
            (declared.state_weights, problem.states, width),
            (declared.control_weights, problem.controls, reach),
        )
    )
    try:
        return riccati.regulator(A, B, *weights)
    except riccati.Unstabilizable as error:
        raise BadInput(
            "the controls cannot stabilize the linearisation along the orbit: they do not reach a "
            f"mode of multiplier {error.multiplier:.6g}; choose another orbit or kind",
            where,
        ) from None
    except (riccati.Unsolved, np.linalg.LinAlgError):
        raise BadInput(
            "the Riccati equation along the orbit could not be solved in doubles; choose weights "
            "that differ less, or kind linear",
            where,
        ) from None


def _scaled(given: dict[str, float], name: str, unit: float) -> float:
    """Return the binary logarithm of a weight per unit squared; by default it is 1."""
    return math.log2(given[name]) + 2 * math.log2(unit) if name in given else 0.0

"""Improvement passes that leave out cells where no other control can be better.

Along a falling sequence of values V the Q of a pair falls too, but no faster than V does: if
V' >= r V then gamma P_a V' + G_a >= r (gamma P_a V + G_a) for 0 < r <= 1, because G_a >= 0. So the
least Q among the rivals of a cell's control, divided by the product of all ratios before it was
found, times that of all so far, bounds them from below for ever. A cell whose value is below that
bound needs no look at its rows. Late passes read a few numbers a cell, no rows.

A bound for every pair would leave out more rows, but takes longer than it saves: a processor reads
all rows of a cell in less time than it takes to find out which of them to read.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate import vectors
from lmdsl.common.types import Bools, Floats, Policy
from lmdsl.machine.forking import cached_property
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.linear.policy_system import Slots, copy_row
from lmdsl.optimize.policies import bellman

LEAST_SCALE = 1e-30  # scale below which all ratios are made anew
MOST = 1e308  # value above which a rival's is kept as this one


@dataclass(frozen=True, eq=False)
class Pass:
    """The outcome of one pass."""

    value: Floats  # min(V, T V) where a control changed, min(V, T_u V) elsewhere, shape (n,)
    policy: Policy  # the policy after the pass, shape (n,)
    changed: int  # number of cells whose control changed
    looked: int  # number of rows read


class Rivals(NamedTuple):
    """The control of each cell and what is known of its rivals, as compiled loops use them."""

    policy: NDArray[np.uint64]  # A pair of each cell, shape (n,)
    # bound, scale: ``bound * scale`` is below the Q of every rival; shape (n,)
    bound: Floats
    scale: float


class Improved(NamedTuple):
    """What a pass finds, as compiled loops write it: see :class:`Pass` and :class:`Screen`."""

    value: Floats
    policy: NDArray[np.uint64]
    policy_cost: Floats


class Tied(NamedTuple):
    """The tied columns, the first of each cell, and space for the Q of a cell's pairs."""

    ties: Bools
    first: Policy
    q: Floats


class Screen:
    """Lower bounds of the Q of the rivals of each cell's control, along a falling V.

    Parameters
    ----------
    lp
        The model.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).

    Attributes
    ----------
    slots, policy_cost
        The rows of the policy after the last pass, copied while they are at hand, and its stage
        costs, shape (n,).
    """

    def __init__(
        self, lp: StabilizationLP, gamma: float | None = None, cost: Floats | None = None
    ) -> None:
        self.lp = lp
        self.gamma = lp.gamma if gamma is None else gamma
        self.cost = lp.cost if cost is None else cost
        self.rival = np.zeros(lp.n)
        self.policy_cost = np.full(lp.n, np.nan)
        self.scale = 1.0
        self.passes = 0
        self.policy: Policy | None = None  # whose rivals

    @cached_property
    def slots(self) -> Slots:
        """Memory for the rows of the policy."""
        lp = self.lp
        return Slots.of(lp.rows, lp.pair_pointer, self.gamma, lp._directions)

    def improve(self, V: Floats, policy: Policy, margin: float) -> Pass:
        """Change a control where another one is better: Q < Q_u - margin |Q_u|.

        Cells are visited forwards and backwards by turns, each with the new values of those before
        it in the same range of cells, so that changes spread far in a pass. V >= T_u V, shape (n,);
        so a policy other than that of the last pass is looked at wherever it differs, as one of its
        rivals.
        """
        lp = self.lp
        value, new = np.empty(lp.n), np.empty(lp.n, dtype=np.int64)
        x, backwards = vectors.padded(lp, V), self.passes % 2 == 1
        self.passes += 1
        rivals = Rivals(policy.view(np.uint64), self.rival, self.scale)
        found = Improved(value, new.view(np.uint64), self.policy_cost)
        pair_pointer, slots = lp._kernel[0], self.slots.kernel

        def part(*cells: int) -> tuple[int, int]:
            own = x.copy()
            return _pass(  # type: ignore[no-any-return]
                *cells, pair_pointer, slots, self.cost, own, margin, backwards, rivals, found
            )

        counts = vectors.over_cells(lp, part, most=bellman.IN_PLACE)
        self.policy = new
        return Pass(value, new, *(int(sum(each)) for each in zip(*counts, strict=True)))

    def tied(self, V: Floats, tolerance: float, policy: Policy) -> tuple[Bools, Policy, bool]:
        """Find the columns with Q <= Q_min + tolerance |Q_min| at V, and those of a policy.

        V is optimal to a relative 1e-9, and of the policy. Returns the ties, shape (K,), the
        first tied column of every cell, shape (n,), and whether a cell has more than one.
        """
        lp = self.lp
        x, ties = vectors.padded(lp, V), np.empty(lp.K, dtype=np.bool_)
        first = np.empty(lp.n, dtype=np.int64)
        known = self.policy is not None and np.array_equal(self.policy, policy)
        bound = self.rival if known else np.zeros(lp.n)
        rivals = Rivals(policy.view(np.uint64), bound, self.scale)
        most = int(np.diff(lp.pair_pointer).max(initial=0))

        def part(*cells: int) -> bool:
            found, model = Tied(ties, first, np.empty(most)), (*lp._kernel, self.cost, self.gamma)
            return bool(_ties(*cells, *model, x, tolerance, rivals, found))

        return ties, first, any(vectors.over_cells(lp, part))

    def follow(self, before: Floats, after: Floats) -> None:
        """Note that V fell from ``before`` to ``after``."""
        self.scale *= _least_ratio(before, after) * (1 - 1e-13)
        if self.scale < LEAST_SCALE:
            self.rival *= self.scale
            self.scale = 1.0


def _least_ratio(before: Floats, after: Floats) -> float:
    """Return the smallest after / before where ``before`` is positive, at most 1."""
    ratio = np.divide(after, before, out=np.ones(len(before)), where=before > 0)
    return float(np.fmin.reduce(ratio, initial=1.0))


@kernel
def _pass(first, last, pair_pointer, slots, cost, x, margin, backwards, rivals, found):  # type: ignore[no-untyped-def]
    """Improve the cells of a range in turn; ``rivals`` gets the bounds of those that were read.

    ``x`` is V, a copy for each range: the others keep the values from before the pass.

    V_i >= Q of the cell's own pair, so where the bound of the rivals is V_i or more none is better.
    """
    pointer, target, code, share = slots.rows
    (policy, rival, scale), (value, new, policy_cost) = rivals, found
    gamma, copied = slots.gamma, slots.copied
    changed, looked = 0, np.uint64(0)
    first, last = np.uint64(first), np.uint64(last)
    store, shrink = (1.0 - 1e-12) / scale, 1.0 / scale
    for t in range(last - first):
        i = last - ONE - t if backwards else first + t
        own, begin, end = policy[i], pair_pointer[i], pair_pointer[i + ONE]
        new[i] = own
        if rival[i] < x[i] * shrink:
            best, second, choice = np.inf, np.inf, own
            for k in range(begin, end):
                q = 0.0
                for e in range(pointer[k], pointer[k + ONE]):
                    q += share[code[e]] * x[target[e]]
                q = gamma * q + cost[k]
                # No branch for the second: processors guess it wrong, at half of the time.
                larger = q if q > best else best
                second = larger if larger < second else second
                if q < best:
                    best, choice = q, k
            looked += end - begin
            if choice != own:
                own_q = 0.0  # once more: to watch out for it in the loop takes longer
                for e in range(pointer[own], pointer[own + ONE]):
                    own_q += share[code[e]] * x[target[e]]
                own_q = gamma * own_q + cost[own]
                if best < own_q - margin * abs(own_q):
                    changed += 1
                    new[i] = choice
                else:
                    second, best = best, own_q
            if best < x[i]:
                x[i] = best
            rival[i] = second * store if second * store < MOST else MOST
        if copied[i] != new[i]:  # its row is at hand now
            policy_cost[i] = cost[new[i]]
            copy_row(i, new[i], slots)
    for i in range(first, last):
        value[i] = x[i]
    return changed, looked


@kernel
def _ties(first, last, pair_pointer, rows, cost, gamma, V, tolerance, rivals, found):  # type: ignore[no-untyped-def]
    """Mark the tied columns of a range of cells: first Q_min, then all that come near.

    Where no rival comes near, no row is read.
    """
    pointer, target, code, share = rows
    (policy, rival, scale), (ties, chosen, q) = rivals, found
    several = False
    first, last = np.uint64(first), np.uint64(last)
    for i in range(first, last):
        begin, end = pair_pointer[i], pair_pointer[i + ONE]
        if rival[i] * scale > V[i] * (1.0 + tolerance + 1e-9):
            for k in range(begin, end):
                ties[k] = k == policy[i]
            chosen[i] = policy[i]
            continue
        best = np.inf
        for k in range(begin, end):
            q_k = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q_k += share[code[e]] * V[target[e]]
            q[k - begin] = gamma * q_k + cost[k]
            best = q[k - begin] if q[k - begin] < best else best
        count, chosen[i] = 0, -1
        for k in range(begin, end):
            ties[k] = (q[k - begin] <= best + tolerance * abs(best)) | (k == policy[i])
            if ties[k]:
                count += 1
                if chosen[i] < 0:
                    chosen[i] = k
        several |= count > 1
    return several

"""Who evaluates the policies of a model that is spread over ranks: rank 0, or all together.

Of a small model rank 0 gets the rows of a policy and uses the code of one process, to its bits.
From some size on all ranks substitute, and only the core is solved by rank 0; no rank has more than
its own rows and the core.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.certificate.checks import MEASURE_TOLERANCE
from lmdsl.certificate.claims import Witness
from lmdsl.common.types import Floats, Policy, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.linear.gauss_seidel import CEILING, TOLERANCE
from lmdsl.optimize.linear.policy_system import Slots
from lmdsl.optimize.policies import evaluation, iteration
from lmdsl.optimize.policies.screening import Screen
from lmdsl.optimize.witness import _first_try
from lmdsl.ranks.mesh import Mesh
from lmdsl.slabs import below
from lmdsl.slabs.chains.first import First
from lmdsl.slabs.chains.peeling import SpreadPeeled

MOST_GATHERED = 10_000  # cells up to which rank 0 evaluates: messages take longer than the work
FEW = 12  # sweeps by which a value is lowered between two passes
MOST_GUESSED = 1e-7  # relative slack above which a lower bound is not made of a policy's own rows


class Evaluator(Protocol):
    """What policy iteration asks of policies, of own columns; every method is collective."""

    def bound(self, policy: Policy, guess: Floats | None) -> Floats | None:
        """Return V >= T_u V of a policy that is proved stabilizing, None where it is not."""

    def lower(self, policy: Policy, V: Floats, screen: Screen) -> tuple[Floats, bool]:
        """Return a lower V >= T_u V for V >= T_u V, and whether it is the value."""

    def value(self, policy: Policy, start: Floats, screen: Screen | None = None) -> Floats:
        """Return the value of a g-stabilizing policy; its rows may be in a screen."""

    def witness(self, policy: Policy, V: Floats, tolerance: float) -> Witness:
        """Return the vectors of a policy's claims, made from its own rows; V is its value."""


@dataclass(frozen=True)
class ByFirst:
    """Rank 0 evaluates."""

    first: First

    def lower(self, policy: Policy, V: Floats, screen: Screen) -> tuple[Floats, bool]:
        """Return the value: as soon known as anything else."""
        return self.value(policy, V), True

    def bound(self, policy: Policy, guess: Floats | None) -> Floats | None:
        """Return V >= T_u V of a policy that is proved stabilizing, None where it is not."""
        under = self.first.model(policy)
        near = None if guess is None else self.first.gathered(guess)

        def found() -> Floats | None:
            assert under is not None
            own = np.arange(under.n)
            if near is None:
                w, _ = evaluation.stability_vector(under, own)
            else:
                w = first_policy._proved(under, own, near, never)
            if w is None:
                return None
            V = iteration.bound(under, own, w)
            return evaluation.evaluate(under, own) if V is None else V

        return self.first.told(
            self.first.mesh.ranks.agreed(lambda: found() if self.first.here else None)
        )

    def value(self, policy: Policy, start: Floats, screen: Screen | None = None) -> Floats:
        """Return the value of a g-stabilizing policy."""
        under, near = self.first.model(policy), self.first.gathered(start)

        def found() -> Floats:
            assert under is not None
            own = np.arange(under.n)
            V = evaluation.evaluate(under, own, start=near, transient=True)
            V = evaluation.evaluate(under, own) if V is None else V
            if V is None:
                raise Stopped
            return V

        return self.first.scattered(
            self.first.mesh.ranks.agreed(lambda: found() if self.first.here else None)
        )

    def witness(self, policy: Policy, V: Floats, tolerance: float) -> Witness:
        """Return the vectors of a policy's claims, made on rank 0 from its own rows."""
        under, value = self.first.model(policy), self.first.gathered(V)

        def made() -> Witness:
            assert under is not None
            return _first_try(under, np.arange(under.n), tolerance, value, never)[0]

        found = self.first.mesh.ranks.agreed(lambda: made() if self.first.here else None)
        names = ("w", "V_up", "W", "mu")
        own = {
            name: self.first.told(None if found is None else getattr(found, name)) for name in names
        }
        return Witness(policy, **own)


@dataclass(frozen=True, eq=False)
class KnownChain:
    """The chain of a policy; its rows may lie in the slots of a screen, until they change."""

    policy: Policy
    chain: SpreadPeeled
    slots: Slots | None

    def serves(self, policy: Policy) -> bool:
        """Return whether it is the chain of a policy still."""
        at_hand = self.slots is None or np.array_equal(self.slots.chosen, policy.view(np.uint64))
        return bool(at_hand and np.array_equal(self.policy, policy))


@dataclass(frozen=True)
class ByAll:
    """All ranks evaluate: by substitution, and the core of the chain apart."""

    lp: StabilizationLP
    time_up: TimeUp
    last: dict[float, KnownChain] = field(default_factory=dict)  # by gamma

    def chain(self, policy: Policy, gamma: float, screen: Screen | None = None) -> SpreadPeeled:
        """Return gamma P_u; the last one is kept."""
        known = self.last.get(gamma)
        if self.mesh.ranks.all(known is not None and known.serves(policy)) and known is not None:
            return known.chain
        self.last.pop(gamma, None)
        slots = screen.slots if screen is not None and screen.gamma == gamma else None
        rows = None if slots is None else slots.system(policy)
        chain = SpreadPeeled.of_chain(self.lp, policy, gamma, rows)
        self.last[gamma] = KnownChain(policy.copy(), chain, slots)
        return chain

    @property
    def mesh(self) -> Mesh:
        """The own cells and ghosts of this rank."""
        assert self.lp.mesh is not None
        return self.lp.mesh

    def stable(
        self,
        policy: Policy,
        guess: Floats | None,
        cost: Floats | None = None,
        under: StabilizationLP | None = None,
    ) -> tuple[Floats, Floats] | None:
        """Return w > 0, d > 0 with w >= g P_u w + d; None where there is none in sight.

        It comes from a guess towards the value under unit cost, or another one that is positive.
        ``under`` is the model under the policy, where it is at hand.
        """
        b = np.ones(self.lp.n) if cost is None else cost
        system = self.chain(policy, self.lp.growth)
        w = b.copy() if guess is None else np.maximum(guess, b)
        for _ in range(first_policy.MOST_ROUNDS):  # it need not be solved to the end
            change = system.advance(b, w, first_policy.SWEEPS, 1e-2 if cost is None else 0.0)
            found = self.proof(policy, w, under) if change < np.inf else None
            if found is not None or not change > TOLERANCE or not change < np.inf:
                break
        if found is not None or not change < np.inf:
            return found
        solved = system.solve(b, w, self.time_up)
        return None if solved is None else self.proof(policy, solved, under)

    def proof(
        self, policy: Policy, w: Floats, under: StabilizationLP | None = None
    ) -> tuple[Floats, Floats] | None:
        """Return w with the d > 0 that it leaves, None where it leaves none."""
        ranks = self.mesh.ranks
        if not ranks.all(bool((np.isfinite(w) & (w > 0)).all())):  # else not all would ask on
            return None
        lp, columns = (self.lp, policy) if under is None else (under, np.arange(under.n))
        d = bounds.decrease(lp, columns, w, lp.growth)
        return None if ranks.any(d is None) or d is None else (w, d)

    def bound(self, policy: Policy, guess: Floats | None) -> Floats | None:
        """Return V >= T_u V of a policy that is proved stabilizing, None where it is not."""
        cost, found = self.lp.cost[policy], None
        even = self._even(policy, cost)
        if even is not None:
            return even
        if guess is not None and self.mesh.ranks.all(bool((cost > 0).all())):
            found = self.stable(policy, guess, cost)  # then V is close to the value
        found = found or self.stable(policy, guess)
        if found is None:
            return None
        w, d = found
        with np.errstate(over="ignore"):
            own = float((cost / d).max(initial=0.0))
            V = w * (max(self.mesh.ranks.collect(own)) * (1 + 1e-12))
        return None if self.mesh.ranks.any(not (V < CEILING).all()) else V

    def _even(self, policy: Policy, cost: Floats) -> Floats | None:
        """Return a constant V >= T_u V within a percent of the value, None where none is."""
        lp, ranks = self.lp, self.mesh.ranks
        some = np.arange(0, lp.n, lp.n // iteration.PROBES + 1)  # few are looked at where none is
        rows = lp.rows.take(policy[some])
        share = np.where(rows.target < rows.columns, rows.shares.value[rows.code], 0.0)
        stays = np.add.reduceat(share, rows.pointer[:-1]) if len(some) else share
        if not ranks.all(bool((lp.growth * stays < 1).all())):
            return None
        found = self.proof(policy, np.ones(lp.n))
        if found is None:
            return None
        ratio = cost / found[1]
        factor = max(ranks.collect(float(ratio.max(initial=0.0)))) * (1 + 1e-12)
        close = factor < CEILING and bool((factor * (1 - 1e-2) <= ratio).all())
        return np.full(lp.n, factor) if ranks.all(close) else None

    def lower(self, policy: Policy, V: Floats, screen: Screen) -> tuple[Floats, bool]:
        """Return V after a few sweeps of the core, exact outside, and whether it is the value."""
        x, cost = V.copy(), screen.policy_cost
        change = self.chain(policy, self.lp.gamma, screen).advance(cost, x, FEW, 0.0)
        if not change < np.inf:
            return V, False
        positive = bool((cost > 0).all())  # else what is free has to become 0
        if change <= TOLERANCE and self.mesh.ranks.all(positive):
            return x, True
        return np.minimum(x, V), False

    def value(self, policy: Policy, start: Floats, screen: Screen | None = None) -> Floats:
        """Return the value of a g-stabilizing policy."""
        system = self.chain(policy, self.lp.gamma, screen)
        V = system.solve(self.lp.cost[policy], start, self.time_up)
        if V is None:
            raise Stopped
        return V

    def witness(self, policy: Policy, V: Floats, tolerance: float) -> Witness:
        """Return the vectors of a policy's claims; V is its value."""
        lp, ranks = self.lp, self.mesh.ranks
        under = lp.under(policy)  # its rows one after the other: they are read some ten times
        w, d = self.stable(policy, None, under=under) or (None, None)
        V_up = None if w is None or d is None else self._above(under, V, w, d)
        W = self._guessed(under, V, tolerance)
        del under
        W = below.lower_vector(lp, V, tolerance, self.time_up) if W is None else W
        flat = 1e-2 * MEASURE_TOLERANCE / sum(ranks.collect(lp.n))
        mu = self.chain(policy, lp.gamma).solve_transposed(lp.weight, self.time_up, flat)
        return Witness(policy, w, V_up, W, mu)

    def _guessed(self, under: StabilizationLP, V: Floats, tolerance: float) -> Floats | None:
        """Return (1 - eps) V as one process guesses it from a policy's own rows; rarely too small.

        Where it does not serve the judge says so.
        """
        every = self.mesh.ranks.collect(bounds.worst_excess(under, V))
        eps = 2 * max(worst for worst, _ in every) + bounds.UNIT
        if any(infinite for _, infinite in every) or not eps < min(tolerance / 4, MOST_GUESSED):
            return None
        return V * (1 - eps)

    def _above(self, under: StabilizationLP, V: Floats, w: Floats, d: Floats) -> Floats | None:
        """Return V + delta w that is an upper bound, as one process makes it."""
        own = np.arange(under.n)
        for _ in range(4):
            future = bounds.expected_above(under, own, V, under.gamma)
            residual = bounds.add_above(future, under.cost) - V
            share = max(self.mesh.ranks.collect(float((residual / d).max(initial=0.0))))
            if share <= 0:
                break
            V = V + share * 1.01 * w
        return V


def evaluator(lp: StabilizationLP, gathered: int, time_up: TimeUp) -> Evaluator:
    """Return who evaluates: rank 0 up to so many cells, else all."""
    assert lp.mesh is not None
    small = lp.mesh.division.cells <= gathered
    return ByFirst(First(lp)) if small else ByAll(lp, time_up)

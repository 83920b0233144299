"""The claims of a policy over ranks: each rank judges its own cells, and all must agree.

A claim is an inequality for every cell or pair, so it holds where it holds on every rank. What a
rank needs of other cells it reads by global number (``ranks/reading.py``). Numbers that are summed
over ranks are rounded outward once more. What only rational arithmetic decides is not claimed.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from lmdsl.certificate import bounds, checks, sums
from lmdsl.certificate.bounds import _inflow
from lmdsl.certificate.claims import Certificate, Found, Witness
from lmdsl.certificate.judge import OnTrial, certificate
from lmdsl.common.types import Floats, Policy
from lmdsl.model.lp import StabilizationLP
from lmdsl.ranks.reading import Read, added
from lmdsl.ranks.verbs import Ranks
from lmdsl.slabs import safety
from lmdsl.slabs.graph import levels
from lmdsl.slabs.graph.levels import OwnRows


def verdict(lp: StabilizationLP, witness: Witness, tolerance: float) -> Certificate:
    """Judge a witness, of own cells and columns; collective, with one outcome for all ranks."""
    assert lp.mesh is not None
    judge = _Judge(lp.mesh.ranks, replace(lp, mesh=Read.again(lp.mesh)))
    lost = 0
    judged = OnTrial(lp.gamma, lp.mesh.division.cells, lambda: lost)
    if judge.refusal(witness):
        found = {"refusal": Found(True)}
        return certificate(lp, True, found, None, tolerance, None, judged)
    policyless = not judge.own_policy(witness.policy)
    contraction = judge.contraction(witness)
    if contraction is None and not policyless:  # then it is looked for why
        lost = _lost(lp, witness.policy)
    upper, lower = judge.upper(witness), judge.lower(witness.W)
    residual, measure = judge.measure(witness)
    cost = judge.weighed(witness.V_up, math.inf) if upper else None
    upper = upper and cost is not None and cost < math.inf
    least = judge.weighed(witness.W, -math.inf) if lower else None
    gap = judge.gap(witness.V_up, witness.W) if upper and lower else None
    found = {
        "stabilizing": Found(contraction is not None, contraction),
        "upper_bound": Found(upper, cost if upper else None),
        "lower_bound": Found(lower, least), "measure": Found(measure, residual),
    }  # fmt: skip
    unsafe = None if policyless else judge.unsafe(witness.policy)
    return certificate(lp, policyless, found, gap, tolerance, unsafe, judged)


def _lost(lp: StabilizationLP, policy: Policy | None) -> int:
    """Return the number of cells from which a policy never reaches A; collective, no claim."""
    assert lp.mesh is not None
    assert policy is not None
    known = OwnRows(np.arange(lp.n + 1, dtype=np.int64), lp.rows.take(policy))
    level, _ = levels.tree(lp.mesh, known, np.ones(lp.n, dtype=np.bool_))
    return sum(lp.mesh.ranks.collect(int((level < 0).sum())))


@dataclass(frozen=True)
class _Judge:
    """The claims one by one; every method is collective."""

    ranks: Ranks
    lp: StabilizationLP

    def sound(self, x: Floats | None) -> bool:
        """Return whether every rank has a finite number >= 0 for each of its cells."""
        return self.ranks.all(x is not None and checks.is_sound(self.lp, x))

    def own_policy(self, policy: Policy | None) -> bool:
        """Return whether every rank has a column of each of its cells' own."""
        if policy is None or len(policy) or self.lp.n:
            return self.ranks.all(policy is not None and checks.is_policy(self.lp, policy))
        return self.ranks.all(True)  # no cell at all

    def refusal(self, witness: Witness) -> bool:
        """Claim 6, of a witness without a policy."""
        w = witness.refusal
        if not self.ranks.all(witness.policy is None) or not self.sound(w) or w is None:
            return False
        some = self.ranks.any(bool(w.any()))
        return some & self.ranks.all(bounds.holds_for_all(self.lp, w, self.lp.gamma, None))

    def contraction(self, witness: Witness) -> float | None:
        """Claim 1: the bound on rho(g P_u), the largest of all ranks; None where it fails."""
        policy, w = witness.policy, witness.w
        known = self.own_policy(policy) & self.sound(w)
        if not known or policy is None or w is None or not self.ranks.all(bool((w > 0).all())):
            return None
        d = bounds.decrease(self.lp, policy, w, self.lp.growth)
        share = None if d is None else float((d / w).min(initial=np.inf)) * (1 - 4 * bounds.UNIT)
        every = self.ranks.collect(share)
        if any(each is None for each in every):
            return None
        found = float(np.nextafter(1 - min(each for each in every if each is not None), 2.0))
        return max(found, 0.0) if found < 1 else None

    def upper(self, witness: Witness) -> bool:
        """Claim 2."""
        policy, V_up = witness.policy, witness.V_up
        known = self.own_policy(policy) & self.sound(V_up)
        if not known or policy is None or V_up is None:
            return False
        future = bounds.expected_above(self.lp, policy, V_up, self.lp.gamma)
        total = bounds.add_above(future, self.lp.cost[policy])
        return self.ranks.all(bool((V_up >= total).all()))

    def lower(self, W: Floats | None) -> bool:
        """Claim 3."""
        if not self.sound(W) or W is None:
            return False
        return self.ranks.all(bounds.holds_for_all(self.lp, W, self.lp.gamma, self.lp.cost))

    def measure(self, witness: Witness) -> tuple[float | None, bool]:
        """Claim 4: the residual, rounded up, and whether it holds.

        Mass that flows into a ghost is added by its owner: another order of the same sum, to which
        the bound on rounding applies as it stands.
        """
        policy, mu, lp = witness.policy, witness.mu, self.lp
        known = self.own_policy(policy) & self.sound(mu)
        if not known or policy is None or mu is None:
            return None, False
        total, entries = np.zeros(lp.rows.columns + 1), np.zeros(lp.rows.columns + 1)
        with np.errstate(over="ignore", invalid="ignore"):
            _inflow(policy.view(np.uint64), lp.rows.kernel, lp.gamma, mu, total, entries)
            total, entries = self.to_owners(total), self.to_owners(entries)
            terms, most = entries + 8, max(self.ranks.collect(float(mu.max(initial=0.0))))
            absolute = (1 + lp.gamma) * terms * bounds.LEAST * (1 + most)
            rounding = terms * bounds.UNIT * (lp.weight + mu + total) + absolute
            residual = np.abs((lp.weight - mu) + total)
            own = sums.total_above(residual + rounding), float(mu.sum()) * (1 - 70 * bounds.UNIT)
        every = self.ranks.collect(own)
        bound = sums.total([r for r, _ in every]) * (1 + 4 * bounds.UNIT)  # type: ignore[arg-type]
        size = sums.total([s for _, s in every]) * (1 - 4 * bounds.UNIT)  # type: ignore[arg-type]
        allowed = checks.MEASURE_TOLERANCE * max(1.0, size) * (1 - 4 * bounds.UNIT)
        return (bound if math.isfinite(bound) else math.inf), bound <= allowed < math.inf

    def unsafe(self, policy: Policy | None) -> int | None:
        """Claim 7: of how many cells it is not proved; None where it is not made.

        What cells are is asked of their owners, whatever compiling made of them.
        """
        if self.lp.problem.successors != "enclosed" or policy is None:
            return None
        return safety.unproved(self.ranks, self.lp, policy)

    def to_owners(self, x: Floats) -> Floats:
        """Return what all ranks have for own cells, added up."""
        mesh = self.lp.mesh
        assert mesh is not None
        ghosts = x[mesh.own : mesh.columns]
        return added(self.ranks, mesh.division, mesh.ghosts, ghosts, x[: mesh.own])

    def weighed(self, x: Floats | None, direction: float) -> float:
        """Return m'x rounded towards ``direction``."""
        assert x is not None
        own = sums.weighted(self.lp.weight, x, direction) if len(x) else 0.0
        total = sums.total(self.ranks.collect(own))  # type: ignore[arg-type]
        return max(float(np.nextafter(total, direction)), 0.0) if total else 0.0

    def gap(self, V: Floats | None, W: Floats | None) -> float:
        """Return m'(V - W) / m'V rounded up, 0 where m'V is 0."""
        assert V is not None
        assert W is not None
        cost = self.weighed(V, -math.inf)
        width = self.weighed(np.maximum(V - W, 0.0) * (1 + 4 * bounds.UNIT), math.inf)
        if not width:
            return 0.0
        with np.errstate(divide="ignore", over="ignore"):
            ratio = np.float64(width) / np.float64(cost) * (1 + 8 * bounds.UNIT)
        return float(np.nextafter(ratio, math.inf))

"""Optimal values of the finite model, an optimal policy, and ties."""

import math
from dataclasses import dataclass, field
from fractions import Fraction

from reference.gamma_bar import gamma_bracket
from reference.model import ReferenceModel
from reference.policies import Arrays, policy_iteration
from reference.reaching import can_reach, surely_reaching


@dataclass
class ReferenceSolution:
    """Optimal values. V, policy and ties are empty when nothing was solved."""

    status: str  # "ok" or "not_stabilizable"
    gamma: float
    gamma_bar: tuple[float, float] | None  # proved bracket; None if C is empty
    decided: bool  # False: gamma lies inside the bracket, so that the status is only a guess
    V: dict[int, float] = field(default_factory=dict)
    policy: dict[int, int] = field(default_factory=dict)
    ties: dict[int, set[int]] = field(default_factory=dict)  # within 1e-9 relative of optimal
    cost: float | None = None  # m'V
    policy_reaches: bool = False  # the policy given reaches A from all of C (can fail if gamma < 1)
    tied_policy_reaches: bool = False  # some policy within `ties` does


def solve_reference(model: ReferenceModel, gamma: float | None = None) -> ReferenceSolution:
    """Optimal values on C over the gamma-stabilizing policies (over all policies if gamma < 1)."""
    if gamma is None:
        gamma = float(model.problem.get("gamma", 1.0))
    bracket = gamma_bracket(model)
    if bracket is None:
        return ReferenceSolution("not_stabilizable", gamma, None, True)
    low, high, policy, growth = bracket
    bar = (low, high)
    if not model.m:
        return ReferenceSolution("not_stabilizable", gamma, bar, True)
    if Fraction(gamma) * growth >= 1:
        return ReferenceSolution("not_stabilizable", gamma, bar, True)
    if gamma > low:
        return ReferenceSolution("not_stabilizable", gamma, bar, False)

    arrays = Arrays(model)
    V, policy = policy_iteration(arrays, arrays.G, gamma, policy)
    Q = arrays.G + gamma * (arrays.P @ V)
    ties = [[k for k in c if Q[k] <= V[i] + 1e-9 * V[i]] for i, c in enumerate(arrays.choices)]
    tied_pairs = {arrays.pairs[k] for c in ties for k in c}
    value = {c: float(V[i]) for i, c in enumerate(arrays.cells)}
    C = set(arrays.cells)
    return ReferenceSolution(
        status="ok",
        gamma=gamma,
        gamma_bar=bar,
        decided=True,
        V=value,
        policy={c: arrays.pairs[policy[i]][1] for i, c in enumerate(arrays.cells)},
        ties={c: {arrays.pairs[k][1] for k in ties[i]} for i, c in enumerate(arrays.cells)},
        cost=math.fsum(weight * value[c] for c, weight in model.m.items()),
        policy_reaches=can_reach(model, [arrays.pairs[k] for k in policy]) == C,
        tied_policy_reaches=surely_reaching(model, tied_pairs)[0] == C,
    )

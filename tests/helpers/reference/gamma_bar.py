"""A bracket of gamma_bar that is proved in exact arithmetic."""

import math
from fractions import Fraction

import numpy as np

from reference.model import ReferenceModel
from reference.policies import (
    Arrays,
    communicating_classes,
    nilpotent_policy,
    policy_iteration,
    stabilizes,
    tree_policy,
)


def gamma_bracket(model: ReferenceModel) -> tuple[float, float, list[int], Fraction] | None:
    """Return (low, high, policy, growth): the policy is stabilizing at every gamma <= low (proved).

    No policy is stabilizing where gamma * growth >= 1 (proved, exact); high = 1/growth. None if C
    is empty.
    """
    if model.proved is None and model.surviving:
        model.proved = _gamma_bracket(Arrays(model))
    return model.proved


def _gamma_bracket(arrays: Arrays) -> tuple[float, float, list[int], Fraction]:
    policy = nilpotent_policy(arrays)
    if policy is not None:
        return math.inf, math.inf, policy, Fraction(0)
    one = np.ones(arrays.K)
    policy = tree_policy(arrays)
    best = largest_gamma(arrays.P[policy], 1.0)
    while True:  # unit cost just below the reach of a policy prefers every policy that reaches more
        gamma = best * (1 - 1e-9)
        _, other = policy_iteration(arrays, one, gamma, policy)
        reach = largest_gamma(arrays.P[other], gamma)
        if reach <= best * (1 + 1e-10):
            break
        policy, best = other, reach
    low = best
    while not _proved_stabilizing(arrays, policy, low):
        low *= 1 - 1e-9
    growth = Fraction(0)
    for digits in range(2, 10):
        V, _ = policy_iteration(arrays, one, best * (1 - 10.0**-digits), policy)
        growth = max(growth, _unavoidable_growth(arrays, V))
    return low, (float(1 / growth) if growth else math.inf), policy, growth


def largest_gamma(P: np.ndarray, gamma: float) -> float:
    """Bisection for the gamma up to which a policy is stabilizing, from one at which it is."""
    classes = communicating_classes(P)
    low = gamma
    high = 2.0 * low
    while stabilizes(P, high, classes) is not None:
        low, high = high, 2.0 * high
    while high - low > 1e-11 * low:
        middle = 0.5 * (low + high)
        if stabilizes(P, middle, classes) is None:
            high = middle
        else:
            low = middle
    return low


def _proved_stabilizing(arrays: Arrays, policy: list[int], gamma: float) -> bool:
    """Check w > gamma P_u w, w > 0, in exact arithmetic."""
    w = stabilizes(arrays.P[policy], gamma)
    if w is None:
        return False
    exact = [Fraction(float(v)) for v in w]
    g = Fraction(gamma)
    return all(exact[i] > 0 and exact[i] > g * arrays.exact(k, exact) for i, k in enumerate(policy))


def _unavoidable_growth(arrays: Arrays, V: np.ndarray) -> Fraction:
    """Return the largest lam found with P_a w >= lam w for all a: no policy has rho < lam.

    The candidates for w are V on its largest entries and 0 elsewhere.
    """
    best, best_w = 0.0, None
    order = np.argsort(-V)
    for size in range(1, arrays.n + 1):
        w = np.zeros(arrays.n)
        w[order[:size]] = V[order[:size]]
        Pw = arrays.P @ w
        lam = min(Pw[k] / w[i] for i in order[:size] for k in arrays.choices[i])
        if lam > best:
            best, best_w = lam, w
    if best_w is None:
        return Fraction(0)
    exact = [Fraction(float(v)) for v in best_w]
    return min(
        arrays.exact(k, exact) / exact[i]
        for i in range(arrays.n)
        if exact[i] > 0
        for k in arrays.choices[i]
    )

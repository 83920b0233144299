"""What is true of a model, by plain linear algebra."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

SAMPLES = 6


CLAIMS = ("stabilizing", "upper_bound", "lower_bound", "measure")


def truly(model, gamma, weight, choice, witness, samples=SAMPLES):
    """Decide the four claims straight from their definition, in fractions."""
    n, rate, g = len(model), Fraction(gamma), Fraction(max(gamma, 1.0))

    def numbers(x):
        sound = np.isfinite(x).all() and (x >= 0).all()
        return [Fraction(v) for v in x.tolist()] if sound else None

    def mean(row, x):
        return sum((x[j] * c for j, c in row.items() if j >= 0), Fraction(0)) / samples

    w, V, W, mu = (numbers(x) for x in (witness.w, witness.V_up, witness.W, witness.mu))
    policy = None
    if all(0 <= k < len(c) for k, c in zip(choice, model, strict=True)):
        policy = [model[i][k] for i, k in enumerate(choice)]
    held = dict.fromkeys(CLAIMS, False)
    if W is not None:
        held["lower_bound"] = all(
            W[i] <= rate * mean(row, W) + Fraction(cost) for i in range(n) for row, cost in model[i]
        )
    if policy is None:
        return held
    if w is not None:
        held["stabilizing"] = all(w[i] > g * mean(policy[i][0], w) for i in range(n))
    if V is not None:
        held["upper_bound"] = all(
            V[i] >= rate * mean(row, V) + Fraction(cost) for i, (row, cost) in enumerate(policy)
        )
    if mu is not None:
        rest = [Fraction(float(weight[i])) - mu[i] for i in range(n)]
        for i, (row, _) in enumerate(policy):
            for j, count in row.items():
                if j >= 0:
                    rest[j] += rate * mu[i] * count / samples
        held["measure"] = sum(map(abs, rest)) <= Fraction(1e-9) * max(Fraction(1), sum(mu))
    return held

"""Policies: their values, their improvement, and policies to begin with."""

from fractions import Fraction

import numpy as np

from reference.model import ReferenceModel
from reference.reaching import reaches_in_one


class Arrays:
    """The surviving pairs as dense arrays: P (K, n), G (K,), and the pairs of every cell."""

    def __init__(self, model: ReferenceModel):
        self.model = model
        self.cells = model.C
        self.index = {c: i for i, c in enumerate(self.cells)}
        self.pairs = model.surviving
        self.n, self.K = len(self.cells), len(self.pairs)
        self.P = np.zeros((self.K, self.n))
        self.G = np.array([model.cost[p] for p in self.pairs])
        self.choices: list[list[int]] = [[] for _ in self.cells]
        for k, pair in enumerate(self.pairs):
            self.choices[self.index[pair[0]]].append(k)
            for target, share in model.rows[pair][0].items():
                self.P[k, self.index[target]] = float(share)

    def exact(self, k: int, w: list[Fraction]) -> Fraction:
        """(P w)[k] in exact arithmetic."""
        row = self.model.rows[self.pairs[k]][0]
        return sum((share * w[self.index[t]] for t, share in row.items()), Fraction(0))


def communicating_classes(P: np.ndarray) -> list[np.ndarray]:
    """Sort cells into classes that reach each other; a class stands after those it leads to."""
    R = (P > 0) | np.eye(len(P), dtype=bool)
    while True:  # the transitive closure
        more = (R.astype(float) @ R.astype(float)) > 0
        if np.array_equal(more, R):
            break
        R = more
    both = R & R.T
    first = [i for i in range(len(P)) if not both[i, :i].any()]
    first.sort(key=lambda i: int(R[i].sum()))  # who leads to another class reaches more cells
    return [np.flatnonzero(both[i]) for i in first]


def policy_value(
    P: np.ndarray, G: np.ndarray, gamma: float, classes: list[np.ndarray] | None = None
) -> np.ndarray:
    """Solve V = G + gamma P V class by class; exactly zero where no cost can ever be met."""
    V = np.zeros(len(G))
    with np.errstate(all="ignore"):
        for at in communicating_classes(P) if classes is None else classes:
            right = G[at] + gamma * (P[at] @ V)  # V is still zero on the class itself
            if not right.any():
                continue
            if len(at) == 1:
                V[at] = right / (1.0 - gamma * P[at, at])
                continue
            inside = P[np.ix_(at, at)]
            matrix = np.eye(len(at)) - gamma * inside
            try:
                inverse = np.linalg.inv(matrix)
                v = inverse @ right
                for _ in range(3):  # iterative refinement, residual in long double
                    long = v.astype(np.longdouble)
                    image = np.longdouble(gamma) * (inside.astype(np.longdouble) @ long)
                    residual = (right - (long - image)).astype(float)
                    v = (long + inverse @ residual).astype(float)
            except np.linalg.LinAlgError:
                v = np.full(len(at), np.nan)
            V[at] = v
    return V


def stabilizes(
    P: np.ndarray, gamma: float, classes: list[np.ndarray] | None = None
) -> np.ndarray | None:
    """Return w > 0 with w > gamma P w, which proves rho(gamma P) < 1; None if none is found."""
    w = np.ones(len(P))
    for _ in range(2):  # the second round makes w smoother, so that rounding hurts less
        old = w
        w = policy_value(P, old, gamma, classes)
        if not (np.isfinite(w).all() and (w > 0).all()):
            return None
    with np.errstate(all="ignore"):
        slack = w - gamma * (P @ w)
    return w if (slack >= 0.5 * old).all() and (old > 1e-13 * w).all() else None


def policy_iteration(
    arrays: Arrays, G: np.ndarray, gamma: float, policy: list[int]
) -> tuple[np.ndarray, list[int]]:
    """Improve a gamma-stabilizing policy; change a control only where strictly better."""
    for _ in range(10_000):
        V = policy_value(arrays.P[policy], G[policy], gamma)
        if not (np.isfinite(V).all() and (V >= 0).all()):
            raise ArithmeticError("a policy that should be stabilizing has no finite value")
        Q = G + gamma * (arrays.P @ V)
        better = list(policy)
        for i, choices in enumerate(arrays.choices):
            k = min(choices, key=lambda k: Q[k])
            if Q[k] < Q[policy[i]] * (1 - 1e-13):
                better[i] = k
        if better == policy:
            return V, policy
        policy = better
    raise ArithmeticError("policy iteration does not end")


def tree_policy(arrays: Arrays) -> list[int]:
    """Breadth-first levels from A: from every cell of C the policy reaches A."""
    chosen: dict[int, int] = {}
    reached: set[int] = set()
    while len(chosen) < arrays.n:
        level: dict[int, int] = {}
        for i, choices in enumerate(arrays.choices):
            if i in chosen:
                continue
            for k in choices:
                row = arrays.model.rows[arrays.pairs[k]]
                if arrays.model.ends or reaches_in_one(row, reached):
                    level[i] = k
                    break
        chosen |= level
        reached |= {arrays.cells[i] for i in level}
    return [chosen[i] for i in range(arrays.n)]


def nilpotent_policy(arrays: Arrays) -> list[int] | None:
    """Levels of pairs all of whose successors are in A or lower: exists iff gamma_bar is inf."""
    chosen: dict[int, int] = {}
    done: set[int] = set()
    while len(chosen) < arrays.n:
        level: dict[int, int] = {}
        for i, choices in enumerate(arrays.choices):
            if i in chosen:
                continue
            for k in choices:
                if all(t in done for t in arrays.model.rows[arrays.pairs[k]][0]):
                    level[i] = k
                    break
        if not level:
            return None
        chosen |= level
        done |= {arrays.cells[i] for i in level}
    return [chosen[i] for i in range(arrays.n)]

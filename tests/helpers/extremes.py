"""Numbers from the smallest double to the largest."""

from __future__ import annotations

import sys
from dataclasses import replace
from fractions import Fraction

import numpy as np
from models import build

from lmdsl.model.discretization import Nodes
from lmdsl.model.rows import Rows, Shares

LARGEST = sys.float_info.max
NUMBERS = [
    5e-324, 1e-323, 1e-310, 2.3e-308, 1e-300, 1e-200, 1e-154, 1e-17, 0.1, 0.5, 1.0, 3.0, 1e17,
    1e154, 1e200, 1e300, 8e307, 1.7e308, LARGEST,
]  # fmt: skip
GAMMAS = [5e-324, 1e-300, 1e-17, 0.5, 0.9, 1.0, 1 + 2**-52, 1.3, 2.0, 1e17, 1e300, LARGEST]
WEIGHTS = [
    [1.0], [0.5, 0.5], [0.1] * 11, [0.1, 0.2, 0.7], [1.0, 1e-17], [1.0, 5e-324], [0.5, 0.5, 5e-324],
    [1.0, *[1e-17] * 10], [0.3, 1e-300, 0.7],
]  # fmt: skip
"""Eleven times LARGEST / 11 rounds to infinity."""


def number(rng, zero=0.1):
    if rng.random() < zero:
        return 0.0
    if rng.random() < 0.5:
        return float(rng.choice(NUMBERS))
    return float(rng.random() * 10.0 ** rng.integers(-323, 308))


def numbers(rng, n, zero=0.1):
    """Return numbers of one kind, or each of its own."""
    if rng.random() < 0.3:
        return np.full(n, LARGEST if rng.random() < 0.3 else number(rng, 0.0))
    return np.array([number(rng, zero) for _ in range(n)])


class Model:
    """A random model, twice: as the product stores it, and as exact fractions."""

    def __init__(self, rng):
        n = self.n = int(rng.choice([1, 2, 3, 4, 12]))
        weights = np.array(WEIGHTS[2 if n == 12 else rng.integers(len(WEIGHTS))])
        if len(weights) == 1:  # no noise, some samples
            points = int(rng.integers(1, 8))
            self.shares = Shares.of(points, Nodes(np.zeros((1, 0)), weights, np.zeros(1, int)))
            group, start = np.zeros(points, int), [0]
            sample = [Fraction(1, points)] * points
        else:
            values, group = np.unique(weights, return_inverse=True)
            order = list(dict.fromkeys(group.tolist()))  # groups by first appearance
            group = np.array([order.index(g) for g in group])
            nodes = Nodes(np.zeros((len(weights), 1)), weights, group)
            self.shares = Shares.of(1, nodes)
            start = np.cumsum([0, *np.bincount(group)])[:-1].tolist()
            sample = [Fraction(w) / sum(map(Fraction, weights.tolist())) for w in weights.tolist()]
            del values
        spread = n > 4 and rng.random() < 0.7
        self.gamma = float(rng.choice(GAMMAS))
        self.model, target, code, pointer = [], [], [], [0]
        controls = rng.integers(1, 4, n)
        for i in range(n):
            self.model.append([])
            for _ in range(controls[i]):
                some = rng.integers(-1, n, 2)
                goes = rng.choice(some, len(group)) if rng.random() < 0.5 else some[0] + 0 * group
                if spread:
                    goes = rng.permutation(n)[: len(group)]
                row = {}
                for j in np.unique(goes):
                    row[int(j)] = sum(s for s, to in zip(sample, goes, strict=True) if to == j)
                    for g in np.unique(group[goes == j]):
                        target.append(n if j < 0 else j)
                        code.append(start[g] + int(((goes == j) & (group == g)).sum()) - 1)
                pointer.append(len(target))
                self.model[i].append((row, number(rng, 0.3)))
        rows = Rows(
            np.array(pointer), np.array(target, np.int32), np.array(code, np.uint8), self.shares, n
        )
        cost = np.array([cost for choices in self.model for _, cost in choices])
        control = np.concatenate([np.arange(c) for c in controls]).astype(np.int32)
        m = np.array([min(number(rng), 0.5 / n) for _ in range(n)])
        m[rng.integers(n)] = 0.0
        m[m.argmin()] = 1 - m.sum()
        self.lp = replace(
            build(np.cumsum([0, *controls]), control, rows, cost, 1.0), gamma=self.gamma, weight=m
        )

    def backup(self, i, k, x, rate, cost=True):
        row, paid = self.model[i][k]
        mean = sum((Fraction(x[j]) * s for j, s in row.items() if j >= 0), Fraction(0))
        return Fraction(rate) * mean + (Fraction(paid) if cost else 0)

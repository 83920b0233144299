"""Random finite models without dynamics behind them, for property tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from problems import made, steps

import lmdsl as lm
from lmdsl.model import stabilizable_set
from lmdsl.model.discretization import Nodes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows, Shares, code_type


def random_lp(
    rng: np.random.Generator,
    cells: int = 8,
    controls: int = 3,
    samples: int = 6,
    gamma: float = 1.0,
    zero: float = 0.0,
    spread: int = 3,
    absorb: float = 0.3,
) -> lm.StabilizationLP:
    """Return a random model on which every cell is stabilizable.

    Parameters
    ----------
    zero
        Probability that a stage cost is zero.
    spread
        Largest number of distinct successors of a pair.
    absorb
        Probability that a sample goes to the attractor.
    """
    shares = Shares.of(samples, Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64)))
    rows: list[dict[int, int]] = []
    per_cell = rng.integers(1, controls + 1, size=cells)
    for i in range(cells):
        for a in range(per_cell[i]):
            support = rng.integers(0, cells, size=rng.integers(1, spread + 1))
            hits = rng.choice(support, size=samples)
            if (a == 0 and rng.random() < 0.9) or rng.random() < 0.3:
                hits[rng.random(samples) < absorb] = cells
            if a == 0 and i == 0:
                hits[0] = cells
            if a == 0 and i > 0 and rng.random() < 0.8:
                hits[-1] = rng.integers(0, i)
            rows.append({int(j): int((hits == j).sum()) for j in np.unique(hits)})
    pointer = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
    compact = Rows(
        pointer,
        np.array([j for r in rows for j in r], dtype=np.int32),
        np.array([c - 1 for r in rows for c in r.values()], dtype=np.uint8),
        shares,
        cells,
    )
    pair_pointer = np.concatenate([[0], np.cumsum(per_cell)]).astype(np.int64)
    control = np.concatenate([np.arange(k) for k in per_cell]).astype(np.int32)
    cost = rng.random(len(rows)) * 10.0 ** rng.integers(-2, 3)
    cost[rng.random(len(rows)) < zero] = 0.0
    lp = build(pair_pointer, control, compact, cost, gamma)
    found = stabilizable_set.stabilizable(pair_pointer, compact)
    if found.inside.all() and found.surviving.all():
        return lp
    return _only(lp, found)


def build(pair_pointer, control, rows, cost, gamma) -> lm.StabilizationLP:
    """Wrap rows in an LP whose box has one cell per row block and one attractor cell."""
    n = len(pair_pointer) - 1
    data = steps(gamma)
    data["state_box"] = {"x": {"low": 0, "high": n + 1, "cells": n + 1}}
    data["attractor"] = {"cells": [[n]]}
    top = max(int(control.max(initial=0)), 1)
    data["control_grid"] = {"u": {"low": 0, "high": top, "points": top + 1}}
    problem = made(data)
    status = np.ones(n + 1, dtype=np.uint8)
    status[n] = 0
    return lm.StabilizationLP(
        problem=problem,
        partition=Partition.of(problem),
        controls=np.arange(top + 1.0)[:, None],
        cell_status=status,
        cells=np.arange(n, dtype=np.int64),
        pair_pointer=pair_pointer,
        control=control,
        rows=rows,
        cost=cost,
        gamma=gamma,
        weight=np.full(n, 1 / max(n, 1)),
    )


def _only(lp, found) -> lm.StabilizationLP:
    """Keep C and the surviving pairs, numbering the cells anew."""
    kept = np.flatnonzero(found.surviving)
    inside = np.flatnonzero(found.inside)
    renumber = np.full(lp.n + 1, -1, dtype=np.int32)
    renumber[inside] = np.arange(len(inside))
    renumber[lp.n] = len(inside)
    taken = lp.rows.take(kept)
    rows = replace(taken, target=renumber[taken.target], columns=len(inside))
    count = np.bincount(renumber[lp.cell[kept]], minlength=len(inside))
    pair_pointer = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return build(pair_pointer, lp.control[kept], rows, lp.cost[kept], lp.gamma)


def mdp(cells, samples: int, gamma: float) -> lm.StabilizationLP:
    """Return a model written out: per cell a list of ({successor: count}, cost), -1 is A."""
    n = len(cells)
    shares = Shares.of(samples, Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64)))
    rows = [
        {(n if j == -1 else j): c for j, c in row.items()}
        for choices in cells
        for row, _ in choices
    ]
    assert all(sum(row.values()) == samples for row in rows)
    pointer = np.cumsum([0] + [len(row) for row in rows]).astype(np.int64)
    compact = Rows(
        pointer,
        np.array([j for row in rows for j in row], dtype=np.int32),
        np.array([c - 1 for row in rows for c in row.values()], dtype=code_type(samples)),
        shares,
        n,
    )
    counts = [len(choices) for choices in cells]
    pair_pointer = np.cumsum([0, *counts]).astype(np.int64)
    control = np.concatenate([np.arange(k) for k in counts]).astype(np.int32)
    cost = np.array([g for choices in cells for _, g in choices])
    return build(pair_pointer, control, compact, cost, gamma)


def dense(lp: lm.StabilizationLP) -> np.ndarray:
    """Return P as a dense array, made from the exact rows."""
    P = np.zeros((lp.K, lp.n + 1))
    for k in range(lp.K):
        for j, share in lp.rows.exact(k):
            P[k, j] += share / lp.rows.shares.total
    return P[:, : lp.n]


def all_policies(lp: lm.StabilizationLP) -> np.ndarray:
    """Return every policy, shape (count, n); only for tiny models."""
    grids = np.meshgrid(
        *(np.arange(a, b) for a, b in zip(lp.pair_pointer[:-1], lp.pair_pointer[1:], strict=True)),
        indexing="ij",
    )
    return np.stack([g.ravel() for g in grids], axis=-1)


def brute_force(lp: lm.StabilizationLP) -> tuple[np.ndarray | None, float]:
    """Return the optimal V over g-stabilizing policies, and the least spectral radius of P_u."""
    P, best, least = dense(lp), None, np.inf
    g = max(lp.gamma, 1.0)
    for pair in all_policies(lp):
        Pu = P[pair]
        rho = max(abs(np.linalg.eigvals(Pu)))
        least = min(least, rho)
        if rho * g < 1 - 1e-9:
            V = np.linalg.solve(np.eye(lp.n) - lp.gamma * Pu, lp.cost[pair])
            best = V if best is None else np.minimum(best, V)
    return best, least

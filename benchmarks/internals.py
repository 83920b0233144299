"""Every use of what lmdsl does not promise to keep; nothing else here looks inside."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lmdsl as lm
from lmdsl.machine import memory
from lmdsl.model.discretization import Nodes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows, Shares
from lmdsl.optimize import witness
from lmdsl.optimize.linear.policy_system import of_policy
from lmdsl.optimize.policies import bellman
from lmdsl.optimize.policies.evaluation import evaluate
from lmdsl.ranks import mpi
from lmdsl.ranks.verbs import Ranks
from lmdsl.slabs import compiling, solving
from lmdsl.slabs.chains.evaluating import MOST_GATHERED


def transitions(lp: lm.StabilizationLP) -> tuple[Any, Any, Any]:
    """Return pointer, target and share of the rows; target n is the attractor."""
    rows = lp.rows
    return rows.pointer, rows.target, rows.shares.value[rows.code]


def compact(lp: lm.StabilizationLP) -> list[NDArray[Any]]:
    """Return the arrays that hold the compact rows."""
    return [lp.rows.pointer, lp.rows.target, lp.rows.code]


def cold(lp: lm.StabilizationLP) -> lm.StabilizationLP:
    """Return the same LP without anything it remembers but what compiling hands over."""
    return replace(lp, rows=replace(lp.rows), _known=lp._algorithm_1)


def improvement_sweep(lp: lm.StabilizationLP, V: NDArray[Any]) -> Callable[[], Any]:
    """Return one improvement sweep over all pairs."""
    return lambda: bellman.improve(lp, V)


def evaluation_sweep(lp: lm.StabilizationLP, policy: NDArray[Any]) -> Callable[[], Any]:
    """Return one evaluation sweep over the rows of a policy."""
    system, b = of_policy(lp, policy, lp.gamma), lp.cost[policy]
    x = b.copy()
    return lambda: system.sweep(b, x, 1)


def evaluation(lp: lm.StabilizationLP, policy: NDArray[Any]) -> Callable[[], Any]:
    """Return the whole evaluation of a policy, from nothing to its value."""
    return lambda: evaluate(lp, policy)


def certificate(lp: lm.StabilizationLP, policy: NDArray[Any], V: NDArray[Any]) -> Callable[[], Any]:
    """Return the making and checking of a certificate."""
    return lambda: witness.certify(lp, policy, 1e-6, V)


@contextlib.contextmanager
def estimates() -> Iterator[list[int]]:
    """Collect the bytes that lmdsl says it will need, before it starts."""
    seen: list[int] = []
    require = memory.require

    def noted(estimate: int, *rest: Any, **more: Any) -> Any:
        seen.append(int(estimate))
        return require(estimate, *rest, **more)

    memory.require = noted
    try:
        yield seen
    finally:
        memory.require = require


def this_rank() -> Ranks:
    """Return this rank, alone where no launcher started several."""
    return mpi.at_hand()


def over_ranks(
    ranks: Ranks, problem: lm.Problem, mark: Callable[[str], None], everybody: bool
) -> dict[str, Any]:
    """Compile, solve and verify a problem over ranks; ``mark`` is told what begins.

    Policies are evaluated by all ranks where ``everybody`` says so, whatever their size.
    """
    lp = compiling.compiled(ranks, problem)
    mark("solve")
    with _told_before_verification(mark):
        found = solving.solved(lp, gathered=0 if everybody else MOST_GATHERED)
    facts = {"cells": lp.n, "pairs": lp.K, "ghosts": len(lp.mesh.ghosts) if lp.mesh else 0}
    if found is None:
        return {**facts, "status": "undecided", "cost": None}
    proof = found.certificate
    return {**facts, "status": "verified" if proof.verified else "unverified", "cost": proof.cost}


@contextlib.contextmanager
def _told_before_verification(mark: Callable[[str], None]) -> Iterator[None]:
    """Tell that vectors are made, once ties are broken, which is the end of solving."""
    broken = solving._ties_broken

    def told(*arguments: Any) -> Any:
        found = broken(*arguments)
        mark("verify")
        return found

    solving._ties_broken = told
    try:
        yield
    finally:
        solving._ties_broken = broken


def random_lp(n: int, M: int, spread: int, samples: int) -> lm.StabilizationLP:
    """Make a random sparse LP from arrays.

    Every pair has up to ``spread`` successors anywhere. In one cell of twenty, control 0 sends one
    sample of ``samples`` to the attractor; nothing else reaches it.
    """
    rng = np.random.default_rng(0)
    K = n * M
    control = np.tile(np.arange(M, dtype=np.int32), n)
    support = rng.integers(0, n, size=(K, spread))
    hits = support[np.arange(K)[:, None], rng.integers(0, spread, size=(K, samples))]
    hits[(control == 0) & (np.arange(K) // M % 20 == 0), 0] = n
    hits.sort(axis=1)
    starts = np.ones(hits.shape, dtype=bool)
    starts[:, 1:] = hits[:, 1:] != hits[:, :-1]
    first = np.flatnonzero(starts.ravel())
    nodes = Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64))
    rows = Rows(
        np.append(0, np.cumsum(starts.sum(axis=1))).astype(np.int64),
        hits.ravel()[first].astype(np.int32),
        (np.diff(np.append(first, hits.size)) - 1).astype(np.uint8),
        Shares.of(samples, nodes),
        n,
    )
    frame = _frame(n, M)
    return lm.StabilizationLP(
        problem=frame,
        partition=Partition.of(frame),
        controls=np.arange(float(M))[:, None],
        cell_status=np.append(np.ones(n, dtype=np.uint8), np.uint8(0)),
        cells=np.arange(n, dtype=np.int64),
        pair_pointer=np.arange(0, K + 1, M, dtype=np.int64),
        control=control,
        rows=rows,
        cost=0.1 + rng.random(K),
        gamma=1.0,
        weight=np.full(n, 1 / n),
    )


def _frame(n: int, M: int) -> lm.Problem:
    """Return a problem of the right size; its map is never used."""
    return lm.Problem.model_validate(
        {
            "format": "lmdsl/1",
            "system": {"kind": "map", "next": {"x": "x - u"}},
            "state_box": {"x": {"low": 0, "high": n + 1, "cells": n + 1}},
            "attractor": {"cells": [[n]]},
            "control_grid": {"u": {"low": 0, "high": M - 1, "points": M}},
            "stage_cost": "1",
            "sampling": {"kind": "grid", "per_axis": 2},
        }
    )

"""The reference on random problems: laws, a linear program, and exact brute force."""

import itertools
import json
import math
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
from random_problems import CORNER_CASES, describe, random_problem
from reference import (
    Arrays,
    Axis,
    ReferenceModel,
    classify,
    compile_reference,
    solve_reference,
)
from scipy.optimize import linprog


@pytest.fixture(scope="module")
def drawn():
    """Random problems and their models."""
    problems = [random_problem(np.random.default_rng(seed)) for seed in range(50)]
    return [(p, compile_reference(p)) for p in problems]


# random problems ------------------------------------------------------------------------------


def test_random_problems_are_reproducible_and_json():
    for seed in range(5):
        one, two = (random_problem(np.random.default_rng(seed)) for _ in range(2))
        assert json.dumps(one, allow_nan=False) == json.dumps(two, allow_nan=False)


@pytest.mark.long
def test_random_problems_vary(drawn):
    seen = Counter()
    for problem, model in drawn:
        assert model.N <= 200
        assert model.M <= 6
        assert model.S <= 28  # corners are added
        seen.update(k for k in ("avoid", "noise", "measure", "gamma") if k in problem)
        seen.update(problem["attractor"].keys())
        seen[problem["system"]["kind"]] += 1
        seen[problem["sampling"]["kind"]] += 1
        seen[problem.get("on_exit", "forbid")] += 1
        seen[f"d={len(model.axes)} p={len(problem['control_grid'])}"] += 1
        seen.update({f"status {s}" for s in model.cell_status})
        seen["C"] += bool(model.C)
        solution = solve_reference(model)
        seen[solution.status] += 1
        gamma = problem.get("gamma", 1)
        seen["gamma < 1" if gamma < 1 else "gamma = 1" if gamma == 1 else "gamma > 1"] += 1
        seen["at gamma_bar"] += bool(model.C) and 1 < solution.gamma_bar[0] <= gamma
    assert seen["C"] >= len(drawn) / 2
    expected = ["avoid", "noise", "measure", "gamma", "points", "boxes", "cells", "map", "ode"]
    expected += ["grid", "random", "sobol", "clip", "forbid", "ok", "not_stabilizable"]
    expected += ["gamma < 1", "gamma = 1", "gamma > 1", "at gamma_bar"]
    expected += [f"status {k}" for k in range(6)]
    assert [k for k in expected if seen[k] < 3] == []


def test_rows_sum_to_exactly_one(drawn):
    for problem, model in drawn + [(p, compile_reference(p)) for p in CORNER_CASES]:
        for pair, (targets, absorbed, escaped) in model.rows.items():
            assert sum(targets.values()) + absorbed + escaped == 1, describe(problem)
            assert (pair in model.admissible) == (escaped == 0)
            counts = model.counts[pair].values()
            assert [sum(c) for c in zip(*counts, strict=True)] == [model.points] * len(model.noise)
        for cell, control in model.surviving:
            targets, absorbed, _ = model.rows[cell, control]
            assert all(model.cell_status[t] == 1 for t in targets)
            assert sum(targets.values()) + absorbed == 1
        assert sum(model.m.values()) == pytest.approx(1 if model.m else 0)


def test_values_satisfy_the_optimality_equation(drawn):
    for problem, model in drawn:
        solution = solve_reference(model)
        assert solution.decided, describe(problem)
        for cell, V in solution.V.items():
            Q = {}
            for c, u in model.surviving:
                if c == cell:
                    row = model.rows[c, u][0]
                    mean = math.fsum(float(p) * solution.V[t] for t, p in row.items())
                    Q[u] = model.cost[c, u] + solution.gamma * mean
            assert min(Q.values()) == pytest.approx(V, rel=1e-11)
            assert Q[solution.policy[cell]] == pytest.approx(V, rel=1e-11)


def test_a_linear_program_finds_the_same_cost(drawn):
    """Max sum of V s.t. V <= gamma P V + G, by HiGHS."""
    for problem, model in drawn:
        solution = solve_reference(model)
        if solution.status != "ok" or max(solution.V.values()) > 1e4:
            continue
        a = Arrays(model)
        E = np.zeros((a.K, a.n))
        for k, (cell, _) in enumerate(a.pairs):
            E[k, a.index[cell]] = 1.0
        lp = linprog(-np.ones(a.n), A_ub=E - solution.gamma * a.P, b_ub=a.G, bounds=(None, None))
        assert lp.status == 0, describe(problem)
        assert -lp.fun == pytest.approx(sum(solution.V.values()), rel=1e-5, abs=1e-5)


# exact brute force, tiny models ---------------------------------------------------------------


def tiny_model(rng):
    """A finite model drawn directly: up to four cells outside A, up to three controls."""
    n, M = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    model = ReferenceModel(
        problem={"gamma": 1.0},
        axes=[Axis("x", 0.0, 1.0, n + 1, False)],
        controls=[(float(u),) for u in range(M)],
        N=n + 1,
        M=M,
        S=4,
        points=4,
        noise=[((), 1.0)],
        attractor={0},
        avoid=set(),
        counts={},
        rows={},
        admissible=set(),
        cost={},
    )
    for pair in itertools.product(range(1, n + 1), range(M)):
        landed = Counter(int(t) for t in rng.integers(-1, n + 1, 4 if rng.random() < 0.6 else 1))
        if rng.random() < 0.7:
            landed.pop(-1, None)
        if not landed:
            landed[0] = 1
        share = {t: Fraction(k, sum(landed.values())) for t, k in landed.items()}
        absorbed, escaped = share.pop(0, Fraction(0)), share.pop(-1, Fraction(0))
        model.rows[pair] = share, absorbed, escaped
        if escaped == 0:
            model.admissible.add(pair)
            model.cost[pair] = float(rng.choice([0, 0, 1, 2, 0.375]))
    classify(model)
    return model


def solve_exactly(matrix, right):
    """Gauss-Jordan with fractions; None if singular."""
    n = len(right)
    rows = [[*row, r] for row, r in zip(matrix, right, strict=True)]
    for i in range(n):
        pivot = next((j for j in range(i, n) if rows[j][i] != 0), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for j in range(n):
            if j != i and rows[j][i] != 0:
                factor = rows[j][i]
                rows[j] = [v - factor * p for v, p in zip(rows[j], rows[i], strict=True)]
    return [row[n] for row in rows]


def brute_force(model, gamma):
    """Least value of every cell over all stabilizing policies, None if there is none."""
    C, gamma = model.C, Fraction(gamma)
    choices = [[p for p in model.surviving if p[0] == cell] for cell in C]
    values = []
    for policy in itertools.product(*choices):
        matrix = [
            [Fraction(i == j) - gamma * model.rows[p][0].get(j, Fraction(0)) for j in C]
            for i, p in zip(C, policy, strict=True)
        ]
        w = solve_exactly(matrix, [Fraction(1)] * len(C))
        if w is not None and all(v > 0 for v in w):  # w = gamma P w + 1, w > 0
            values.append(solve_exactly(matrix, [Fraction(model.cost[p]) for p in policy]))
    if not values:
        return None
    least = [min(v[i] for v in values) for i in range(len(C))]
    assert least in values  # one policy is best everywhere
    return {c: float(v) for c, v in zip(C, least, strict=True)}


def exact_stabilizable_set(model):
    """Cells outside A from which some policy reaches A surely and never escapes, by enumeration."""
    cells = range(1, model.N)
    found = set()
    for policy in itertools.product(range(model.M), repeat=model.N - 1):
        rows = {c: model.rows[c, u] for c, u in zip(cells, policy, strict=True)}
        bad = {c for c in cells if rows[c][2] > 0}
        for _ in cells:
            bad |= {c for c in cells if any(t in bad for t in rows[c][0])}
        good = set(cells) - bad
        reach = set()
        for _ in cells:
            reach |= {c for c in good if rows[c][1] > 0 or any(t in reach for t in rows[c][0])}
        lost = good - reach
        for _ in cells:
            lost |= {c for c in good if any(t in lost for t in rows[c][0])}
        found |= good - lost
    return found


def test_brute_force_agrees():
    rng = np.random.default_rng(7)
    seen = Counter()
    for _ in range(100):
        model = tiny_model(rng)
        assert set(model.C) == exact_stabilizable_set(model)
        for gamma in (0.75, 1.0, 1.25, 2.0, 4.0):
            if not model.C:
                assert solve_reference(model, gamma).status == "not_stabilizable"
                continue
            solution, exact = solve_reference(model, gamma), brute_force(model, gamma)
            seen[gamma, solution.status] += 1
            low, high = solution.gamma_bar
            if low < gamma < high:
                assert high <= low * (1 + 1e-6)
                seen["undecided"] += 1
                continue
            assert (solution.status == "ok") == (exact is not None)
            assert pytest.approx(exact or {}, rel=1e-11) == solution.V
    assert seen["undecided"] <= 5
    for gamma in (1.25, 2.0, 4.0):
        assert seen[gamma, "ok"] >= 10
        assert seen[gamma, "not_stabilizable"] >= (1 if gamma == 1.25 else 10)

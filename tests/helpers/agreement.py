"""A problem, compiled and solved by lmdsl and by the independent reference."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from problems import made
from reference import compile_reference, solve_reference

import lmdsl as lm


def compare(data):
    expected = compile_reference(data)
    lp = lm.compile(made(data))
    assert lp.cell_status.tolist() == list(expected.cell_status)
    columns = list(zip(lp.cells[lp.cell].tolist(), lp.control.tolist(), strict=True))
    assert columns == sorted(expected.surviving)
    for k, pair in enumerate(columns):
        assert lp.column(*pair) == k
        row: dict[int, Fraction] = {}
        absorbed = ended = Fraction(0)
        total, codes = lp.rows.total(k), lp.rows.code[slice(*lp.rows.pointer[k : k + 2])]
        for (j, share), code in zip(lp.rows.exact(k), codes, strict=True):
            if code == lp.rows.shares.ended:
                assert (j, ended) == (lp.n, 0)
                ended = Fraction(share, total)
            elif j == lp.n:
                absorbed += Fraction(share, total)
            else:
                cell = int(lp.cells[j])
                row[cell] = row.get(cell, Fraction(0)) + Fraction(share, total)
        targets, reference_absorbed, escaped = expected.rows[pair]
        assert escaped == 0
        assert ended == 1 - expected.discount
        assert sum(row.values()) + absorbed + ended == 1
        if not data.get("noise"):
            assert row == targets
            assert absorbed == reference_absorbed
        assert set(row) == set(targets)
        for cell, share in targets.items():
            assert float(row[cell]) == pytest.approx(float(share), rel=1e-14)
    cost = [expected.cost[pair] for pair in columns]
    np.testing.assert_allclose(lp.cost, cost, rtol=1e-12, atol=0)
    m = {int(cell): w for cell, w in zip(lp.cells, lp.weight, strict=True) if w}
    assert m == pytest.approx({cell: w for cell, w in expected.m.items() if w})
    _compare_solution(data, expected, lp)


def _compare_solution(data, expected, lp):
    known = solve_reference(expected)
    result = lm.solve(lp)
    if not known.decided:
        assert result.status != "solver_failed"
        return
    if known.status == "not_stabilizable":
        assert result.status == "not_stabilizable", result.message
        return
    if data.get("gamma", 1) >= 1 or known.policy_reaches or expected.ends:
        assert result.status == "verified", result.message
    elif not known.tied_policy_reaches:
        assert result.status == "unverified", result.message
    cost = known.cost
    floor = 1e-12 * max(cost, 1e-300)
    assert result.lower_bound <= cost * (1 + 1e-9) + floor
    if result.cost is not None:
        assert result.cost >= cost * (1 - 1e-9) - floor
        assert result.cost <= cost * (1 + 1e-6) + floor
    for cell, V in known.V.items():
        assert result.lower[cell] <= V * (1 + 1e-9) + floor
        if result.status == "verified":
            assert result.value[cell] >= V * (1 - 1e-9) - floor
            if known.policy_reaches:
                assert int(result.control_index[cell]) in known.ties[cell]

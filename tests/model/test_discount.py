"""The discount: exact shares, closed forms, what is stabilizable, and what reports say."""

from __future__ import annotations

import json
import math
from fractions import Fraction

import numpy as np
import pytest
from certificate_files import checked, exported, parsed
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.results.exports import export_drn
from lmdsl.results.result import Result

NOISE = {"w": {"values": [0.1, -0.2, 0.02], "weights": [0.1, 0.2, 0.7]}}


def wandering(discount=0.9, **more):
    """A noisy map that stays in its box for ever; no attractor."""
    system = {"kind": "map", "next": {"x": "0.8*x + 0.1*u + w"}}
    box = {"x": {"low": -2, "high": 2, "cells": 30}}
    data = steps(cost="x**2 + u**2/10", system=system, state_box=box, noise=NOISE)
    return {**data, "attractor": {}, "on_exit": "clip", "discount": discount, **more}


def test_without_a_discount_nothing_changes():
    plain = lm.compile(made(steps()))
    assert plain.digest == "f6c265b05dc281fe271a0582d0c9619071541932e63370866c5cae466a9d887a"
    assert plain.rows.shares.ended is None
    assert "discount" not in made(steps()).to_dict()


@pytest.mark.parametrize("data", [steps(discount=0.3), doubling(discount=1 - 2.0**-40),
                                  wandering(0.9), wandering(5e-324)])  # fmt: skip
def test_rows_are_b_times_the_rows_without(data):
    """Exactly, with b as the double that it is, and 1 - b ends the run."""
    b = Fraction(data["discount"])
    lp = lm.compile(made(data))
    reach = {**data, "attractor": data["attractor"] or {"cells": [[0]]}}
    without = {k: v for k, v in reach.items() if k != "discount"}
    base = lm.compile(made(without))
    number = dict(zip(base.cells.tolist(), range(base.n), strict=True))
    for k in range(lp.K):
        total, row = lp.rows.total(k), lp.rows.exact(k)
        assert sum(c for _, c in row) == total
        assert row[-1][0] == lp.n
        assert Fraction(row[-1][1], total) == 1 - b
        found: dict[int, Fraction] = {}
        for j, c in row[:-1]:
            cell = int(lp.cells[j]) if j < lp.n else -1
            found[cell] = found.get(cell, Fraction(0)) + Fraction(c, total)
        assert sum(found.values()) == b
        i = number.get(int(lp.cells[lp.cell[k]]))
        if i is None or not data["attractor"]:
            continue
        old = base.column(int(lp.cells[lp.cell[k]]), int(lp.control[k]))
        expected: dict[int, Fraction] = {}
        for j, c in base.rows.exact(old):
            cell = int(base.cells[j]) if j < base.n else -1
            expected[cell] = expected.get(cell, Fraction(0)) + b * Fraction(c, base.rows.total(old))
        assert found == expected
    np.testing.assert_array_equal(
        lp.rows.shares.value,
        [float(Fraction(c, lp.rows.shares.total)) for c in lp.rows.shares.numerator],
    )


@pytest.mark.parametrize(("gamma", "b"), [(1, 0.9), (1.05, 0.9), (0.5, 0.5), (1, 1 - 1e-6)])
def test_closed_form_of_an_autonomous_system(gamma, b):
    """V = (I - gamma b P)^-1 G, by elimination in fractions."""
    data = wandering(b, gamma=gamma, control_grid={})
    data["system"] = {"kind": "map", "next": {"x": "0.8*x + w"}}
    data["stage_cost"] = "x**2"
    data["state_box"]["x"]["cells"] = 12
    result = lm.solve(made(data))
    assert result.status == "verified", result.message
    lp = result.lp
    assert lp.n == 12
    rate = Fraction(gamma) * Fraction(b)
    matrix = [[Fraction(int(i == j)) for j in range(lp.n)] for i in range(lp.n)]
    for k in range(lp.K):
        for j, c in lp.rows.exact(k)[:-1]:
            matrix[k][j] -= Fraction(gamma) * Fraction(c, lp.rows.total(k))
    V = solved(matrix, [Fraction(float(g)) for g in lp.cost])
    for cell, exact in zip(lp.cells, V, strict=True):
        assert Fraction(float(result.lower[cell])) <= exact <= Fraction(float(result.value[cell]))
        assert float(exact) == pytest.approx(result.value[cell], rel=1e-6)
    assert all(sum(row) == 1 - rate for row in matrix)


def solved(matrix, right):
    """Gauss-Jordan elimination."""
    rows = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for i in range(len(rows)):
        pivot = next(r for r in range(i, len(rows)) if rows[r][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for r in range(len(rows)):
            if r != i and rows[r][i]:
                f = rows[r][i]
                rows[r] = [x - f * y for x, y in zip(rows[r], rows[i], strict=True)]
    return [row[-1] for row in rows]


def test_nothing_is_trapped_while_gamma_times_b_is_below_1():
    """x+ = x: only A is in A; whoever stays pays 1/(1 - gamma b)."""
    still = steps(system={"kind": "map", "next": {"x": "x"}}, control_grid={})
    assert lm.solve(made(still)).status == "not_stabilizable"
    for gamma, b in ((1.0, 0.75), (1.2, 0.75), (0.5, 0.75)):
        found = lm.solve(made({**still, "gamma": gamma, "discount": b}))
        assert found.status == "verified"
        assert found.value[1:] == pytest.approx([1 / (1 - gamma * b)] * 3)
        assert "attractor or the discounted end" in found.message
    beyond = lm.solve(made({**still, "gamma": 4 / 3 * (1 + 1e-15), "discount": 0.75}))
    assert beyond.status == "not_stabilizable"
    assert beyond.cell_status.tolist() == [0, 3, 3, 3]


def test_the_limit_of_gamma_speaks_of_the_product():
    """The doubling map: rho* = 1/2, so gamma_bar = 2 without a discount and 2/b with b."""
    for b in (0.5, 0.9):
        bracket = lm.gamma_max(made(doubling(discount=b)))
        assert bracket.low <= 2 / b * (1 + 1e-12)
        assert bracket.high >= 2 / b * (1 - 1e-12)
        assert bracket.high / bracket.low < 1 + 2e-6
        assert lm.solve(made(doubling(1.99 / b, discount=b))).status == "verified"
        refused = lm.solve(made(doubling(2.01 / b, discount=b)))
        assert (refused.status, refused.cause) == ("not_stabilizable", "gamma")
    alone = lm.gamma_max(made(wandering(0.8)))
    assert alone.low <= 1 / 0.8 <= alone.high
    assert alone.high / alone.low < 1 + 2e-6


def test_no_target_and_gamma_times_b_not_below_1():
    refused = lm.solve(made(wandering(0.8, gamma=1.25 * (1 + 1e-15))))
    assert (refused.status, refused.cause) == ("not_stabilizable", "empty")
    assert "times the discount 0.8 is not below 1, and there is no attractor" in refused.message
    assert lm.solve(made(wandering(0.8, gamma=1.25 * (1 - 1e-4)))).status == "verified"


def test_escapes_count_as_before():
    """x+ = 2 x + u leaves from the outer cells whatever is done."""
    system = {"kind": "map", "next": {"x": "2*x + u"}}
    box = {"x": {"low": -4, "high": 4, "cells": 16}}
    grid = {"u": {"values": [-2, 0, 2]}}
    data = steps(system=system, state_box=box, control_grid=grid, discount=0.9, attractor={})
    found = lm.solve(made(data))
    assert found.status == "verified"
    centre = np.abs(found.partition.centres(np.arange(16))[:, 0])
    assert (found.cell_status[centre < 2] == 1).all()
    assert (found.cell_status[centre > 3] == 2).all()
    assert "discounted, no target" in found.message
    why = lm.explain(made(data))
    assert {cause.name for cause in why.causes} <= {"escapes", "leads to these"}


def test_ended_and_absorbed_are_kept_apart(tmp_path):
    """From cell 3 of 4, one cell a step: A is reached with probability b^3."""
    b = 0.9
    data = steps(discount=b, control_grid={"u": {"values": [1]}}, cost="1")
    data["measure"] = {"boxes": [{"x": [0.75, 1]}]}
    result = lm.solve(made(data))
    assert result.ended_by_discount == pytest.approx(1 - b**3)
    assert result.value[3] == pytest.approx(1 + b + b * b)
    export_drn(result.lp, tmp_path / "model.drn")
    labels, states = parsed(tmp_path / "model.drn")
    assert labels[-2:] == [["attractor"], ["ended"]]
    exact = Fraction(b)
    assert states[0] == [("0", 1, {3: exact, 4: 1 - exact})]
    assert states[1] == [("0", 1, {0: exact, 4: 1 - exact})]
    status, said = checked(exported(result, tmp_path))
    assert status == 0, said
    lines = (tmp_path / "certificate.jsonl").read_text().splitlines()
    assert [j for j, _ in json.loads(lines[4])[3]] == [3, 4]
    assert math.isclose(lm.solve(made({**data, "gamma": 1.1})).value[3], 1 + 0.99 + 0.99**2)
    assert lm.solve(made({**data, "gamma": 1.1})).ended_by_discount is None


@pytest.mark.parametrize("data", [wandering(), standard_map(12, 1.02, discount=0.99),
                                  steps(discount=0.5, gamma=1.9)])  # fmt: skip
def test_saved_loaded_verified_and_spoiled(data, tmp_path):
    result = lm.solve(made(data))
    result.save(tmp_path / "out")
    assert Result.load(tmp_path / "out").problem == result.problem
    for exact in (False, True):
        assert lm.verify(tmp_path / "out", exact=exact).holds
    assert checked(exported(result, tmp_path))[0] == 0
    stored = json.loads((tmp_path / "out/problem.json").read_text())
    for wrong in (stored["discount"] * (1 + 1e-6), None):
        spoiled = {**stored, "discount": wrong}
        if wrong is None:
            del spoiled["discount"]
            if not data["attractor"]:
                spoiled["attractor"] = {"cells": [[0] * len(data["state_box"])]}
        text = json.dumps(spoiled) + " "
        (tmp_path / "out/problem.json").write_text(text)
        found = lm.verify(tmp_path / "out")
        assert not found.same_model
        assert not found.holds


def test_a_python_function_with_a_discount(tmp_path):
    data = wandering()
    del data["system"], data["format"]
    system = lm.systems.FunctionSystem(next=lambda x, u, w: {"x": 0.8 * x + 0.1 * u + w})
    mine = lm.solve(lm.Problem(system=system, **data))
    assert mine.lp.digest == lm.compile(made(wandering())).digest
    mine.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds


def test_saved_rows_of_a_function_end_as_the_discount_says(tmp_path):
    data = wandering()
    del data["system"], data["format"]
    system = lm.systems.FunctionSystem(next=lambda x, u, w: {"x": 0.8 * x + 0.1 * u + w})
    result = lm.solve(lm.Problem(system=system, **data))
    result.save(tmp_path / "out")
    with np.load(tmp_path / "out/model.npz") as held:
        model = dict(held)
    first, last = model["pointer"][:2]
    for name in ("target", "code"):  # the same entries, the end of the run first
        model[name][first:last] = np.roll(model[name][first:last], 1)
    np.savez(tmp_path / "out/model.npz", **model)
    with pytest.raises(lm.BadInput, match=r"model\.npz: not every row ends by discount"):
        lm.verify(tmp_path / "out")


def test_backends_agree():
    found = lm.compare(made(wandering()), ["policy-iteration", "highs"])
    assert found.exit_status == 0
    assert found.agreement.cost < 1e-6


def test_what_is_said(tmp_path, capsys):
    path = tmp_path / "problem.json"
    path.write_text(json.dumps(wandering()))
    assert main(["solve", str(path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "discount 0.9: discounted, no target" in said
    assert "true map: discounted, no target; 0 of 1,000 runs are lost" in said
    assert "; mean cost " in said
    assert "arrive" not in said
    path.write_text(json.dumps(steps(discount=0.5)))
    assert main(["solve", str(path)]) == 0
    assert "% end in the attractor, " in capsys.readouterr().out


@pytest.mark.parametrize("value", [0, 1, -0.5, 1.5, "0.9", True, None, [0.9]])
def test_refused(value):
    with pytest.raises(lm.BadInput, match="discount"):
        lm.Problem.model_validate_json(json.dumps(steps(discount=value)))

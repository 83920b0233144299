"""The LP object: A, b, c, the column map, the digest, and MPS."""

from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from endless import Asked
from models import dense, random_lp
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.machine.deadline import TimeLimitReached
from lmdsl.model import algorithm_1
from lmdsl.model.algorithm_1 import tree
from lmdsl.model.discretization import Nodes
from lmdsl.model.rows import Shares
from lmdsl.model.stabilizable_set import CellStatus, stabilizable


def test_A_b_c_by_hand():
    # Cells 1, 2, 3; columns (1,0), (1,1), (2,0), (2,1), (3,0), (3,1).
    lp = lm.compile(made(steps(1.25, cost="1 + u")))
    g = 1.25
    expected = np.array(
        [
            [1 - g, 1, 0, -g, 0, 0],
            [0, 0, 1 - g, 1, 0, -g],
            [0, 0, 0, 0, 1 - g, 1],
        ]
    )
    np.testing.assert_array_equal(lp.A.toarray(), expected)
    assert lp.b.tolist() == [1 / 3] * 3
    assert lp.c.tolist() == [1, 2] * 3
    assert lp.cells.tolist() == [1, 2, 3]
    assert lp.control.tolist() == [0, 1] * 3
    assert lp.column(2, 1) == 3
    assert lp.column(0, 0) is None
    assert lp.column(2, 7) is None


@pytest.mark.parametrize("seed", range(10))
def test_A_is_made_of_the_rows(seed):
    lp = random_lp(np.random.default_rng(seed), gamma=1.3)
    E = np.zeros((lp.K, lp.n))
    E[np.arange(lp.K), lp.cell] = 1
    np.testing.assert_allclose(lp.A.toarray(), (E - 1.3 * dense(lp)).T, rtol=1e-15, atol=1e-16)
    np.testing.assert_allclose(lp.P.toarray(), dense(lp), rtol=1e-15)


def test_linear_program_by_scipy_agrees():
    from scipy.optimize import linprog

    lp = lm.compile(made(standard_map(10)))
    found = linprog(lp.c, A_eq=lp.A, b_eq=lp.b, method="highs-ipm")
    result = lm.solve(lp)
    assert result.cost == pytest.approx(found.fun, rel=1e-7)


def test_mps_is_exact(tmp_path):
    import highspy

    lp = lm.compile(made(standard_map(10)))
    lp.write_mps(tmp_path / "lp.mps")
    solver = highspy.Highs()
    solver.setOptionValue("output_flag", False)
    assert solver.readModel(str(tmp_path / "lp.mps")) == highspy.HighsStatus.kOk
    read = solver.getLp()
    matrix = read.a_matrix_
    A = lp.A
    from scipy.sparse import csc_array

    found = csc_array((matrix.value_, matrix.index_, matrix.start_), shape=A.shape)
    assert abs(found - A).max() == 0
    np.testing.assert_array_equal(read.col_cost_, lp.c)
    np.testing.assert_array_equal(read.row_lower_, lp.b)
    np.testing.assert_array_equal(read.row_upper_, lp.b)
    assert read.row_names_[0] == f"d{lp.cells[0]}"
    with pytest.raises(lm.BadInput, match="cannot write"):
        lp.write_mps(tmp_path / "none" / "lp.mps")


def test_digest_sees_every_part():
    lp = lm.compile(made(standard_map(10)))
    seen = {lp.digest}
    cost = lp.cost.copy()
    cost[3] = np.nextafter(cost[3], 9)
    weight = lp.weight.copy()
    weight[0] *= 2
    target = lp.rows.target.copy()
    target[[0, 1]] = target[[1, 0]]
    for other in (
        replace(lp, gamma=1.0200000001),
        replace(lp, cost=cost),
        replace(lp, weight=weight),
        replace(lp, rows=replace(lp.rows, target=target)),
        replace(lp, control=lp.control + np.int32(1)),
    ):
        assert other.digest not in seen
        seen.add(other.digest)
    assert lm.compile(made(standard_map(10))).digest == lp.digest


def test_shares_are_exact():
    weights = np.array([0.1, 0.2, 0.7])
    shares = Shares.of(3, Nodes(np.zeros((3, 1)), weights, np.arange(3)))
    assert len(shares.numerator) == 9
    # Codes: 1..3 samples of the first weight, then of the second, then of the third.
    assert sum(shares.numerator[i] for i in (2, 5, 8)) == shares.total
    np.testing.assert_allclose(shares.value[[0, 3, 6]] * 3, weights, rtol=1e-15)


@pytest.mark.parametrize("seed", range(30))
def test_shares_are_those_of_rational_arithmetic(seed):
    rng = np.random.default_rng(seed)
    weights = rng.random(rng.integers(2, 9)) ** rng.choice([1, 40])
    weights[rng.random(len(weights)) < 0.4] = weights[0]
    first, points = list(dict.fromkeys(weights.tolist())), int(rng.integers(1, 5))
    group = np.array([first.index(w) for w in weights.tolist()])
    shares = Shares.of(points, Nodes(np.zeros((len(weights), 1)), weights, group))
    total = points * sum(map(Fraction, weights.tolist()))
    exact = [
        Fraction(w) * count / total
        for w, size in zip(first, np.bincount(group).tolist(), strict=True)
        for count in range(1, points * size + 1)
    ]
    assert [Fraction(n, shares.total) for n in shares.numerator] == exact
    assert shares.value.tolist() == [float(share) for share in exact]
    assert any(n % 2 for n in (*shares.numerator, shares.total))  # the unit is the largest


def test_many_noise_nodes_do_not_hold_up_a_deadline():
    """Of unequal weights, so that each has shares of its own."""
    rng = np.random.default_rng(0)
    weights, asked = rng.random(10_000), Asked(50)
    nodes = Nodes(np.zeros((len(weights), 1)), weights, np.arange(len(weights)))
    with pytest.raises(TimeLimitReached):
        Shares.of(4, nodes, lambda: asked.raise_if_over("counting"))
    assert asked.count == 50


def brute_stabilizable(pairs, cells):
    """The greatest fixed point by definition, over sets."""
    inside = set(range(cells))
    while True:
        keep = {
            i: [s for s in pairs[i] if all(j in inside or j == cells for j in s)] for i in inside
        }
        reached = set()
        grown = True
        while grown:
            grown = False
            for i in inside - reached:
                if any(any(j == cells or j in reached for j in s) for s in keep[i]):
                    reached.add(i)
                    grown = True
        smaller = {i for i in inside & reached if keep[i]}
        if smaller == inside:
            return inside
        inside = smaller


@pytest.mark.parametrize("seed", range(150))
def test_stabilizable_set_by_definition(seed):
    from models import build

    from lmdsl.model.rows import Rows

    rng = np.random.default_rng(seed)
    cells = int(rng.integers(1, 9))
    pairs = {
        i: [
            sorted(
                {
                    int(j)
                    for j in rng.integers(0, cells + (rng.random() < 0.4), size=rng.integers(1, 4))
                }
            )
            for _ in range(rng.integers(0, 4))
        ]
        for i in range(cells)
    }
    flat = [s for i in range(cells) for s in pairs[i]]
    pointer = np.concatenate([[0], np.cumsum([len(s) for s in flat])]).astype(np.int64)
    shares = Shares.of(6, Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64)))
    rows = Rows(
        pointer,
        np.array(list(itertools.chain(*flat)), dtype=np.int32),
        np.zeros(int(pointer[-1]), dtype=np.uint8),
        shares,
        cells,
    )
    pair_pointer = np.concatenate([[0], np.cumsum([len(pairs[i]) for i in range(cells)])])
    found = stabilizable(pair_pointer.astype(np.int64), rows)
    assert set(np.flatnonzero(found.inside)) == brute_stabilizable(pairs, cells)
    for k, s in enumerate(flat):
        i = int(np.searchsorted(pair_pointer, k, side="right")) - 1
        survives = found.inside[i] and all(j == cells or found.inside[j] for j in s)
        assert found.surviving[k] == survives
    del build


@pytest.mark.parametrize("patience", [0, 0.5, 8])
def test_levels_by_sweeps_and_by_search_are_the_same(patience, monkeypatch):
    """By definition: one more than the least level entered, by the first pair that enters it."""
    monkeypatch.setattr(algorithm_1, "PATIENCE", patience)
    rng = np.random.default_rng(5)
    for _ in range(40):
        lp = random_lp(rng, 30, controls=5, absorb=0.05)
        P = dense(lp) > 0
        spans = itertools.pairwise(lp.rows.pointer)
        absorbed = np.array([lp.n in lp.rows.target[a:b] for a, b in spans])
        level = np.full(lp.n, -1)
        first = np.full(lp.n, -1)
        enters, below = absorbed, 0
        while enters.any():
            for k in np.flatnonzero(enters)[::-1]:
                if level[lp.cell[k]] in (-1, below + 1):
                    level[lp.cell[k]], first[lp.cell[k]] = below + 1, k
            below += 1
            enters = P[:, level == below].any(axis=1) & (level[lp.cell] == -1)
        found = tree(lp.pair_pointer, lp.rows)
        np.testing.assert_array_equal(found[0], level)
        np.testing.assert_array_equal(found[1], first)


@pytest.mark.parametrize("data", [steps(), standard_map(12)])
def test_no_copy_takes_over_what_was_known_of_other_pairs(data):
    lp = lm.compile(made(data))
    for copied in (replace(lp), lp.part(np.arange(lp.K), np.arange(lp.n))):
        for known, found in zip(lp.tree, copied.tree, strict=True):
            np.testing.assert_array_equal(known, found)
    last = lp.under(lp.pair_pointer[1:] - 1)
    found = tree(last.pair_pointer, last.rows)
    for known, true in zip(last.tree, found, strict=True):
        np.testing.assert_array_equal(known, true)


def test_tree_levels_are_distances():
    lp = lm.compile(made(steps()))
    level, pair = lp.tree
    assert level.tolist() == [1, 2, 3]
    assert lp.control[pair].tolist() == [1, 1, 1]
    lp = lm.compile(made(standard_map(20)))
    level, pair = lp.tree
    P = lp.P
    absorbed = 1 - P.sum(axis=1) > 1e-12
    for i in range(lp.n):
        columns = range(lp.pair_pointer[i], lp.pair_pointer[i + 1])
        best = min(
            1 if absorbed[k] else 1 + min(level[P.indices[P.indptr[k] : P.indptr[k + 1]]])
            for k in columns
        )
        assert level[i] == best
        good = [
            k
            for k in columns
            if (absorbed[k] and best == 1)
            or (best > 1 and (level[P.indices[P.indptr[k] : P.indptr[k + 1]]] == best - 1).any())
        ]
        assert pair[i] == good[0]


def test_unreachable_cells_have_no_level():
    data = steps()
    lp = lm.compile(made(data))
    allowed = lp.control == 0  # stay
    level, pair = tree(lp.pair_pointer, lp.rows, allowed)
    assert level.tolist() == [-1] * 3
    assert pair.tolist() == [-1] * 3


def test_statuses_are_the_documented_codes():
    assert [s.name.lower() for s in CellStatus] == [
        "attractor", "stabilized", "escapes", "trapped", "leads_to_these", "avoid",
        "beyond_gamma",
    ]  # fmt: skip


def test_memory_is_bounded_by_chunks():
    # 2,000 samples x 2,000 controls in one cell exceed a chunk by far: still assembled.
    data = steps()
    data["control_grid"] = {"u": {"low": 0, "high": 1, "points": 2000}}
    data["sampling"] = {"kind": "random", "points": 200}
    lp = lm.compile(made(data))
    assert lp.n == 3
    assert (np.diff(lp.rows.pointer) >= 1).all()


def test_controls_in_blocks_equal_controls_at_once(monkeypatch):
    from lmdsl.model.assembly import sampler

    data = standard_map(8)
    whole = lm.compile(made(data))
    for chunk in (1, 37, 999, 2**13):  # one control, some controls, some cells, many cells
        monkeypatch.setattr(sampler, "CHUNK", chunk)
        assert lm.compile(made(data)).digest == whole.digest

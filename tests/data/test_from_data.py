"""Recorded transitions become rows: against a plain count, and what is refused or dropped."""

import json
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lmdsl as lm

BOX = {"x": {"low": 0, "high": 2, "cells": 4}}
KEYS = {
    "state_box": BOX,
    "control_grid": {"u": {"values": [-1, 0, 1]}},
    "stage_cost": "x + u**2",
    "attractor": {"boxes": [{"x": [0, 0.5]}]},
}


def test_a_chain_by_hand():
    """From [0.5, 1) 3 of 4 go to A; from [1, 1.5) all to the cell before; the last has no data."""
    x = [0.5, 0.6, 0.7, 0.9, 1.25]
    problem = lm.from_data(x, [-1] * 5, [0.1, 0.2, 0.3, 0.8, 0.75], **KEYS)
    result = lm.solve(problem)
    at_1 = (0.675 + 1) * 4 / 3  # the mean of the recorded states, 4/3 visits
    assert result.value[[0, 1, 2]].tolist() == pytest.approx([0, at_1, 2.25 + at_1], abs=1e-8)
    assert result.cell_status.tolist() == [0, 1, 1, 2]
    assert problem.system.counts.tolist() == [[0, 0, 0], [4, 0, 0], [1, 0, 0], [0, 0, 0]]
    assert result.lp.rows.exact(0) == [(0, 1), (2, 3)]
    assert result.lp.rows.total(0) == 4


def test_check_counts_the_pairs_that_were_recorded():
    """Two of nine pairs of the three free cells stay, the third was seen to leave."""
    problem = lm.from_data([0.6, 1.1, 1.6], [0, 1, 1], [0.1, 0.7, 2.5], **KEYS)
    assert lm.check(problem).expected.admissible == pytest.approx(2 / 9)


def test_what_rows_were_made_with_is_not_changed_beside_them():
    problem = lm.from_data([0.6], [0], [0.1], **KEYS)
    for key, value in {
        "stage_cost": "2*x",
        "on_exit": "clip",
        "control_grid": {"u": {"values": [-2, 0, 2]}},
        "state_box": {"x": {"low": 0, "high": 4, "cells": 4}},
    }.items():
        with pytest.raises(lm.BadInput, match=rf"{key}: .* call lmdsl.from_data again"):
            problem.replaced(**{key: value})
    assert problem.replaced(gamma=0.5, stage_cost="x + u**2").gamma == 0.5


def test_a_pair_that_was_seen_to_leave_is_inadmissible():
    away = lm.from_data([0.6] * 9, [0] * 9, [0.1] * 8 + [2.5], **KEYS)
    assert lm.solve(away).status == "not_stabilizable"
    infinite = lm.from_data([0.6] * 9, [0] * 9, [0.1] * 8 + [np.inf], **KEYS)
    assert lm.solve(infinite).status == "not_stabilizable"
    clipped = lm.from_data([0.6] * 9, [0] * 9, [0.1] * 8 + [-2.5], on_exit="clip", **KEYS)
    assert lm.solve(clipped).verified
    avoid = lm.from_data([0.6] * 9, [0] * 9, [0.1] * 8 + [1.9], avoid={"boxes": [{"x": [1.5, 2]}]},
                         **KEYS)  # fmt: skip
    assert lm.solve(avoid).status == "not_stabilizable"


def plain_rows(x, u, x_next, periodic):
    """Count with dictionaries: two axes of 3 and 4 cells on [0, 3] x [0, 4], controls 0, 1, 2."""

    def cell(point):
        if not all(np.isfinite(point)):
            return None
        if periodic:
            point = (point[0] % 3, point[1])
        i, j = (int(np.floor(value)) for value in point)
        return 4 * i + j if 0 <= i < 3 and 0 <= j < 4 else None

    counts = {}
    for a, b, c in zip(x, u, x_next, strict=True):
        start = cell(a)
        if start is not None:
            counts.setdefault((start, int(b[0])), Counter())[cell(c)] += 1
    return counts


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.booleans(), st.integers(1, 60), st.sampled_from([0.0, 0.5]))
def test_rows_are_those_of_a_plain_count(seed, periodic, T, smoothing):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-0.5, 3.4, (T, 2))
    u = rng.integers(0, 3, (T, 1)).astype(float)
    x_next = rng.uniform(-0.5, 4.5, (T, 2)) * [0.8, 1]
    x_next[rng.random((T, 2)) < 0.02] = np.inf
    if periodic:
        x[:, 0] = x[:, 0] % 3
    problem = lm.from_data(
        x, u, x_next, smoothing=smoothing,
        state_box={"x": {"low": 0, "high": 3, "cells": 3, "periodic": periodic},
                   "y": {"low": 0, "high": 4, "cells": 4}},
        control_grid={"u": {"low": 0, "high": 2, "points": 3}},
        stage_cost="1", attractor={"cells": [[0, 0]]},
    )  # fmt: skip
    rows, expected = problem.system.rows, plain_rows(x, u, x_next, periodic)
    assert list(zip(rows.cell.tolist(), rows.control.tolist(), strict=True)) == sorted(expected)
    for k, pair in enumerate(sorted(expected)):
        entries = slice(rows.pointer[k], rows.pointer[k + 1])
        share = {
            None if j < 0 else j: Fraction(rows.numerator[c], rows.denominator[c])
            for j, c in zip(rows.target[entries].tolist(), rows.code[entries].tolist(), strict=True)
        }
        count = expected[pair]
        whole = count.total() + Fraction(smoothing) * len(count)
        assert share == {j: (c + Fraction(smoothing)) / whole for j, c in count.items()}
        assert problem.system.counts[pair] == count.total()
    dropped = problem.system.recorded
    used = sum(count.total() for count in expected.values())
    assert (dropped.used, dropped.outside) == (used, T - used)


def test_controls_are_matched_to_the_grid():
    x, x_next = [0.6] * 4, [0.1] * 4
    near = lm.from_data(x, [-1, 1e-7, 1, 1 + 1e-7], x_next, **KEYS)
    assert near.system.counts[1].tolist() == [1, 1, 2]
    with pytest.raises(lm.BadInput, match=r"^u: 2 of 4 controls .* u = 0.4 in transition 1"):
        lm.from_data(x, [-1, 0.4, 1, 1.2], x_next, **KEYS)
    dropped = lm.from_data(x, [-1, 0.4, 1, 1.2], x_next, unmatched="drop", **KEYS)
    assert dropped.system.recorded.unmatched == 2
    assert dropped.system.counts[1].tolist() == [1, 0, 1]
    nearest = lm.from_data(x, [-1, 0.4, 1, 1.2], x_next, control_tolerance=0.5, **KEYS)
    assert nearest.system.counts[1].tolist() == [1, 1, 2]


def test_the_order_of_the_control_values_is_kept():
    keys = KEYS | {"control_grid": {"u": {"values": [1, -1, 0]}}}
    problem = lm.from_data([0.6] * 3, [0, 1, 1], [0.1] * 3, **keys)
    assert problem.system.counts[1].tolist() == [2, 0, 1]


def test_few_transitions_and_states_outside_are_dropped_with_a_count():
    x, u = [0.6, 0.6, 0.6, 1.2, 7.0], [0, 0, 1, 0, 0]
    problem = lm.from_data(x, u, [0.1] * 5, min_count=2, **KEYS)
    recorded = problem.system.recorded
    assert (recorded.transitions, recorded.used, recorded.outside, recorded.few) == (5, 2, 1, 2)
    assert problem.system.counts.sum() == 2
    data = lm.solve(problem).data
    assert "dropped: 1 start outside the box, 2 of pairs with too few" in str(data)
    assert (data.cells_seen, data.pairs_seen) == (1, 1)


def test_smoothing_changes_shares_and_no_count():
    x, u, x_next = [0.6] * 4, [0] * 4, [0.1] * 3 + [0.7]
    plain, smooth = (lm.from_data(x, u, x_next, smoothing=s, **KEYS) for s in (0.0, 1.0))
    assert lm.solve(plain).lp.rows.exact(0) == [(0, 1), (1, 3)]
    assert lm.solve(smooth).lp.rows.exact(0) == [(0, 2), (1, 4)]
    assert smooth.system.counts.tolist() == plain.system.counts.tolist()
    assert lm.solve(smooth.replaced(system=smooth.system.replaced(confidence=0.9))).data.cost == (
        lm.solve(plain.replaced(system=plain.system.replaced(confidence=0.9))).data.cost
    )


def test_names_give_the_order():
    keys = KEYS | {
        "state_box": {"x": BOX["x"], "y": BOX["x"]}, "attractor": {"cells": [[0, 0]]},
        "stage_cost": "a*x + y", "parameters": {"a": 2},
    }  # fmt: skip
    table = {"y": [0.6], "u": [0], "x": [1.2], "y_next": [0.1], "x_next": [0.3]}
    by_table = lm.from_data(table, **keys)
    arrays = lm.from_data([[1.2, 0.6]], [0], [[0.3, 0.1]], **keys)
    assert by_table == arrays
    assert by_table.system.rows.cost.tolist() == [3.0]
    assert by_table.system.rows.target.tolist() == [0]
    structured = np.array([(1.2, 0.6)], dtype=[("x", float), ("y", float)])
    assert lm.from_data(structured, [0], {"y": [0.1], "x": [0.3]}, **keys) == arrays


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": [[0.6, 1], [1, 2]]}, r"^x: states have shape \(..., 1\)"),
        ({"x": [0.6, np.nan]}, r"^x: transition 1 holds nan; leave such transitions out$"),
        ({"x_next": [0.6, np.nan]}, r"^x_next: transition 1 holds nan.*inf where the run left"),
        ({"u": [0, np.inf]}, r"^u: transition 1 holds inf"),
        ({"u": [0, 0, 0]}, r"^u: 3 rows, where x has 2"),
        ({"u": None}, r"^u: give the controls u"),
        ({"u": None, "x_next": None}, r"^x_next: give u and x_next, or a table"),
        ({"x_next": None}, r"^x: a table holds the controls"),
        ({"x": ["a", "b"]}, r"^x: .*no array of numbers"),
        ({"confidence": 1.0}, r"^confidence: "),
        ({"confidence": 95}, r"^confidence: "),
        ({"smoothing": -1}, r"^smoothing: -1 must be"),
        ({"min_count": 0}, r"^min_count: 0"),
        ({"control_tolerance": 0.6}, r"^control_tolerance: 0.6 must be between"),
        ({"unmatched": "keep"}, r"^unmatched: 'keep' is not accepted"),
        ({"stage_cost": "x - 1"}, r"^stage_cost: it is -0\.4.* in transition 0, x = 0.6"),
        ({"stage_cost": "x + v"}, r"^stage_cost: "),
        ({"noise": {"w": {"values": [0], "weights": [1]}}}, r"^noise: recorded data have none"),
        ({"terminal_cost": "x", "confidence": 0.9}, r"^terminal_cost: the bounds"),
        ({"statebox": BOX}, r"statebox"),
    ],
)
def test_what_is_refused(change, message):
    with pytest.raises(lm.BadInput, match=message):
        lm.from_data(**{"x": [0.6, 1], "u": [0, 0], "x_next": [0.1, 0.2], **KEYS, **change})


def test_no_data_is_no_fault_of_the_program():
    with pytest.raises(lm.BadInput, match=r"^x: no transition is given; record at"):
        lm.from_data([], [], [], **KEYS)
    result = lm.solve(lm.from_data([7.0], [0], [0.1], **KEYS))  # begins outside the box
    assert result.status == "not_stabilizable"
    assert "`support`" in result.message
    assert result.data.unseen is None


def test_saved_with_its_rows_and_verified(tmp_path):
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0, 2, 500), rng.integers(-1, 2, 500)
    x_next = (0.5 * x + rng.uniform(0, 0.4, 500)) % 2
    problem = lm.from_data(x, u, x_next, confidence=0.9, discount=0.9, **KEYS)
    result = lm.solve(problem)
    assert result.verified
    result.save(tmp_path / "out")
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.problem == problem
    assert loaded.data == result.data
    assert loaded.to_dict() == result.to_dict()
    for exact in (False, True):
        found = lm.verify(tmp_path / "out", exact=exact)
        assert found.holds, found
        assert found.same_model
    for text in (str(found), str(result.certificate), result.message, str(result.to_dict()["data"]),
                 (tmp_path / "out/certificate.json").read_text()):  # fmt: skip
        assert "support" in text
    assert found.to_dict()["assumes"] == problem.system.assumes


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("certificate.json", '"used": 500', '"used": 501', "data.used"),
        ("certificate.json", '"unseen": [\n      0.', '"unseen": [\n      0.0', "data.unseen"),
        ("certificate.json", '"cost": [\n      ', '"cost": [\n      1', "data.cost"),
        ("certificate.json", "independent draws", "draws", "scope"),
        ("problem.json", '"confidence": 0.9', '"confidence": 0.8', "data"),
        ("problem.json", '"smoothing": 0.0', '"smoothing": 0.5', "smoothing"),
    ],
)
def test_a_spoiled_report_is_not_confirmed(tmp_path, file, old, new, reason):
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0, 2, 500), rng.integers(-1, 2, 500)
    problem = lm.from_data(x, u, 0.5 * x, confidence=0.9, **KEYS)
    lm.solve(problem).save(tmp_path / "out")
    text = (tmp_path / "out" / file).read_text()
    assert old in text
    text = text.replace(old, new, 1)
    if file == "problem.json":  # rewritten by hand, not of another save
        text = json.dumps(json.loads(text))
    (tmp_path / "out" / file).write_text(text)
    if reason == "smoothing":
        with pytest.raises(lm.BadInput, match=reason):
            lm.verify(tmp_path / "out")
        return
    found = lm.verify(tmp_path / "out")
    assert not found.holds
    assert any(reason in each for each in found.reasons), found


class Column:
    """As a series of pandas: one-dimensional, and yet with keys."""

    ndim, dtype = 1, np.dtype(float)

    def __init__(self, values):
        self.values = values

    def keys(self):
        return range(len(self.values))

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=float)


def test_a_column_of_a_table_is_an_array():
    columns = [Column(values) for values in ([0.6, 1.2], [0, 1], [0.1, 0.3])]
    assert lm.from_data(*columns, **KEYS) == lm.from_data([0.6, 1.2], [0, 1], [0.1, 0.3], **KEYS)


def test_tables_of_pandas():
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"u": [0, 1], "x_next": [0.1, 0.3], "x": [0.6, 1.2]})
    expected = lm.from_data([0.6, 1.2], [0, 1], [0.1, 0.3], **KEYS)
    assert lm.from_data(table, **KEYS) == expected
    assert lm.from_data(table["x"], table["u"], table["x_next"], **KEYS) == expected
    assert lm.from_data(table[["x"]], table[["u"]], table["x_next"], **KEYS) == expected


def test_no_file_declares_data():
    with pytest.raises(lm.BadInput, match="kind 'data' cannot be declared in a file"):
        lm.Problem(system={"kind": "data"}, sampling={"kind": "grid", "per_axis": 1}, **KEYS)
    problem = lm.from_data([0.6], [0], [0.1], **KEYS)
    with pytest.raises(lm.BadInput, match="save the result"):
        problem.to_json()


def test_a_state_on_a_circle_is_wrapped_before_it_is_paid_for():
    box = {"x": {"low": 0, "high": 2, "cells": 4, "periodic": True}}
    keys = KEYS | {"state_box": box, "stage_cost": "x"}
    turned = lm.from_data([2.75, -1.25, 0.75], [0, 0, 0], [4.25, -1.75, 0.25], **keys)
    assert turned == lm.from_data([0.75] * 3, [0] * 3, [0.25] * 3, **keys)
    assert turned.system.rows.cost.tolist() == [0.75]

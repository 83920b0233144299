"""Studies: variants in turn, resumed, tabulated, drawn; orders of convergence."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from command_line import run
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.advice.studies import keeping, orders, record, running
from lmdsl.advice.studies.knobs import variants

ODE = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "derivative": {"x": "-u"}, "step": 0.5, "substeps": 3},
    "state_box": {"x": {"low": 0, "high": 4, "cells": 8}},
    "attractor": {"boxes": [{"x": [0, 1]}]},
    "control_grid": {"u": {"values": [0, 1]}},
    "cost_rate": "1",
    "sampling": {"kind": "grid", "per_axis": 2},
}


def row(**more):
    known = {"cells": {"x": 8}, "samples": 2, "step": None, "gamma": 1.0, "backend": "b",
             "status": "verified"}  # fmt: skip
    return record.StudyRow(**{**known, **more})


@pytest.mark.parametrize("ratio", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 4.0])
def test_the_order_of_a_power_is_found(order, ratio):
    rows = [row(cells={"x": round(10 * ratio**k * 1000)}, cost=3 + 2 * ratio ** (-order * k))
            for k in range(4)]  # fmt: skip
    (found,) = orders.orders(rows)
    assert (found.knob, found.quantity, found.held) == ("cells", "cost", {})
    assert found.order == pytest.approx(order, rel=1e-3)
    assert found.limit == pytest.approx(3, rel=1e-3)


def test_uneven_widths_give_the_same_order():
    widths = (0.7, 0.31, 0.11)
    values = [5 - 0.4 * h**1.7 for h in widths]
    assert orders.observed(*widths, *values) == pytest.approx(1.7, rel=1e-9)


@pytest.mark.parametrize(
    "values",
    [(1, 2, 1.5), (1, 2, 2), (1, 2, 3), (1, 2, 4), (1, 1, 1)],
    ids=["alternates", "stands", "goes on", "runs away", "constant"],
)
def test_where_nothing_settles_no_order_is_told(values):
    assert orders.observed(1.0, 0.5, 0.25, *map(float, values)) is None


def test_a_coverage_beyond_all_cells_is_no_limit():
    rows = [row(cells={"x": n}, coverage=c) for n, c in ((8, 0.4), (16, 0.65), (32, 0.85))]
    (found,) = orders.orders(rows)
    assert (found.order, found.limit) == (None, None)


def test_variants_are_all_combinations_and_neighbours_share_a_model():
    given = {"cells": [8, [16]], "gamma": [1, 1.1], "backends": ["policy-iteration", "highs"]}
    found = variants(made(ODE), given)
    assert len(found) == 8
    assert [(v.cells["x"], v.gamma) for v in found[::2]] == [(8, 1), (8, 1.1), (16, 1), (16, 1.1)]
    changed = variants(made(ODE), {"step": [1.0], "samples": [3]})[0].of(made(ODE))
    assert (changed.system.step, changed.system.substeps) == (1.0, 6)
    assert changed.sampling.per_axis == 3
    assert variants(made(ODE), {})[0].of(made(ODE)) == made(ODE)


def test_every_row_is_what_a_solve_says(monkeypatch):
    compiled = []
    solve = running.solve

    def counted(given, *args, **options):
        compiled.append(isinstance(given, lm.Problem))
        return solve(given, *args, **options)

    monkeypatch.setattr(running, "solve", counted)
    problem = made(standard_map(10))
    study = lm.study(problem, cells=[10, 14], gamma=[1.0, 1.02], starts=50)
    assert compiled == [True, False, True, False]  # gamma needs no compilation
    for found in study.rows:
        own = made(standard_map(found.cells["x"], gamma=found.gamma))
        result = lm.solve(own)
        assert found.status == "verified"
        assert found.cost == pytest.approx(result.cost, rel=1e-9)
        assert (found.coverage, found.pairs) == (result.coverage.share, result.pairs)
        assert found.arrives == result.simulate(50).reached / 50
        assert found.brought == found.coverage * found.arrives
    text = str(study)
    assert text.count("verified") == 4
    assert "10x10" in text


def test_what_depends_on_gamma_is_compiled_for_each():
    study = lm.study(made(steps(terminal_cost="x")), gamma=[0.5, 1.0], starts=0)
    for found in study.rows:
        result = lm.solve(made(steps(gamma=found.gamma, terminal_cost="x")))
        assert found.cost == pytest.approx(result.cost, rel=1e-9)
        assert found.arrives is None


def test_a_variant_that_is_no_problem_is_a_row():
    study = lm.study(made(ODE), cells=[3, 8], starts=9)
    bad, good = study.rows
    assert (bad.status, good.status) == ("bad_input", "verified")
    assert "holds no whole cell" in bad.message
    assert "holds no whole cell" in study.table()
    refused = lm.study(made(doubling(3.0)), cells=[2, 4], starts=9)
    assert [r.status for r in refused.rows] == ["not_stabilizable", "bad_input"]
    assert "attractor.cells" in refused.rows[1].message


def test_a_study_goes_on_where_it_ended(tmp_path, monkeypatch):
    problem, out = made(ODE), tmp_path / "study"
    first = lm.study(problem, cells=[8], gamma=[1.0, 1.01], out=out, starts=20)
    solved = []
    solve = running.solve

    def counted(given, *args, **options):
        solved.append(options["start"])
        return solve(given, *args, **options)

    monkeypatch.setattr(running, "solve", counted)
    again = lm.study(problem, cells=[8, 16], gamma=[1.0, 1.01], out=out, starts=20)
    assert again.rows[:2] == first.rows  # seconds included: they are those of then
    assert len(solved) == 2
    assert solved[0].problem.gamma == 1.01  # what was kept is the start
    assert lm.study(problem, cells=[8, 16], gamma=[1.0, 1.01], out=out, starts=20) == again
    assert len(solved) == 2
    lm.study(problem, out=out, starts=21)  # other options: another key
    assert len(solved) == 3
    kept = sorted((out / "variants").iterdir())
    assert len(kept) == 5
    assert all(lm.verify(path).holds for path in kept)


def test_an_interrupted_study_keeps_what_was_finished(tmp_path, monkeypatch):
    calls, solve = [], running.solve

    def stopped(given, *args, **options):
        calls.append(given)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return solve(given, *args, **options)

    monkeypatch.setattr(running, "solve", stopped)
    asked = {"cells": [8, 16], "out": tmp_path / "out", "starts": 5}
    with pytest.raises(KeyboardInterrupt):
        lm.study(made(ODE), **asked)
    assert len(lm.study(made(ODE), **asked)) == 2
    assert len(calls) == 3


def test_folders_that_are_no_study_are_refused_before_work(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(lm.BadInput, match="holds no study"):
        lm.study(made(ODE), out=tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    lm.study(made(ODE), out=tmp_path / "s", starts=0)
    file = tmp_path / "s/study.json"
    good = json.loads(file.read_text())
    (key,) = good["rows"]
    for name, value in (
        ("status", 3), ("cost", "free"), ("cells", {"x": True}), ("interval", [1]),
        ("pairs", 1.5), ("gamma", None), ("cells", {}), ("step", "inf"), ("time", "inf"),
    ):  # fmt: skip
        spoiled = json.loads(json.dumps(good))
        spoiled["rows"][key][name] = value
        file.write_text(json.dumps(spoiled))
        with pytest.raises(lm.BadInput, match="is not accepted") as caught:
            lm.study(made(ODE), out=tmp_path / "s", starts=0)
        assert name in caught.value.where
    for text in ("{}", "[1]", '{"format": "lmdsl-study/1"}', "nonsense",
                 json.dumps({**good, "rows": {key: {}}})):  # fmt: skip
        file.write_text(text)
        with pytest.raises(lm.BadInput):
            lm.study(made(ODE), out=tmp_path / "s", starts=0)


def test_a_row_that_was_put_under_another_variant_is_not_believed(tmp_path):
    asked = {"cells": [8, 16], "out": tmp_path / "s", "starts": 0}
    good = lm.study(made(ODE), **asked)
    file = tmp_path / "s/study.json"
    data = json.loads(file.read_text())
    first, second = data["rows"]
    data["rows"][first], data["rows"][second] = data["rows"][second], data["rows"][first]
    data["rows"][first]["cost"] = "inf"
    file.write_text(json.dumps(data))
    again = lm.study(made(ODE), **asked)
    assert [r.cost for r in again.rows] == [r.cost for r in good.rows]


def test_an_infinite_cost_is_kept(tmp_path):
    folder = keeping.Folder(tmp_path, {})
    folder.add("0" * 64, row(cost=np.inf, gap=np.inf), None)
    (found,) = keeping.Folder(tmp_path, {}).rows.values()
    assert found == row(cost=np.inf, gap=np.inf)
    assert "inf" in record.Study("x", (found,)).table()


@pytest.mark.parametrize(
    ("given", "where"),
    [
        ({"cells": 32}, "cells"),
        ({"cells": []}, "cells"),
        ({"cells": [0]}, "cells[0].x"),
        ({"cells": [[1, 2]]}, "cells[0]"),
        ({"cells": [{"y": 3}]}, "cells[0]"),
        ({"gamma": [1, -1]}, "gamma[1]"),
        ({"gamma": "1"}, "gamma"),
        ({"step": [np.inf]}, "step[0]"),
        ({"samples": [1.5]}, "samples[0]"),
        ({"backends": [3]}, "backends[0]"),
        ({"starts": -1}, "starts"),
    ],
)
def test_values_that_make_no_sense_are_refused(given, where):
    with pytest.raises(lm.BadInput) as caught:
        lm.study(made(ODE), **given)
    assert caught.value.where == where


def test_what_has_no_such_knob_is_refused():
    with pytest.raises(lm.BadInput, match="no step"):
        lm.study(made(steps()), step=[1])
    finite = lm.from_matrices(np.eye(2)[None], np.ones((2, 1)), (0,), layout="states")
    with pytest.raises(lm.BadInput, match="finite model"):
        lm.study(finite, cells=[3])
    with pytest.raises(lm.BadInput, match="not a Problem"):
        lm.study({"problem": 1})


def test_a_study_as_data_and_as_a_table(tmp_path):
    study = lm.study(made(ODE), cells=[8, 16], starts=20, out=tmp_path / "out")
    records = study.records()
    assert records[1]["cells.x"] == 16
    assert records[0]["arrives_low"] < records[0]["arrives"] == 1
    with open(tmp_path / "out/study.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [line["cells.x"] for line in table] == ["8", "16"]
    assert json.loads(json.dumps(study.to_dict()))["rows"][0]["cells"] == {"x": 8}
    pandas = pytest.importorskip("pandas")
    frame = study.to_dataframe()
    assert isinstance(frame, pandas.DataFrame)
    assert frame["cells.x"].tolist() == [8, 16]


def test_names_of_a_stranger_are_inert_in_the_table():
    study = record.Study("x", (row(backend="\x1b[2J", status="bad_input",
                                                     message="a\nb\x07"),))  # fmt: skip
    for text in (str(study), study._repr_html_()):
        assert "\x1b" not in text
        assert "\x07" not in text
    marked = record.Study("x", (row(status="bad_input", message="<b>bold</b>"),))
    assert "<b>" not in marked._repr_html_()


def test_from_the_command_line(tmp_path, capsys):
    file, out = tmp_path / "p.json", tmp_path / "out"
    file.write_text(json.dumps(ODE))
    asked = ["study", file, "--cells", "8,16", "--step", "0.5,1", "--starts", "10", "--out", out]
    status, said, _ = run(capsys, *asked)
    assert status == 0
    assert said.count("verified") == 4
    assert "study.png" in said
    assert (out / "study.png").read_bytes().startswith(b"\x89PNG")
    status, said, error = run(capsys, *asked, "--json")
    assert len(json.loads(said)["rows"]) == 4
    assert "written to" in error
    assert run(capsys, "study", file, "--cells", "3", "--starts", "0")[0] == 1
    for bad, word in (
        (["--cells", "8x8"], "2 numbers for 1 axes"),
        (["--cells", "a"], "not a whole number"),
        (["--gamma", "x"], "not a number"),
        (["--backends", "nobody"], "nobody"),
        (["--samples", "1.5"], "not a whole number"),
    ):
        status, _, error = run(capsys, "study", file, *bad)
        assert (status, error.count("\n")) == (2, 1), bad
        assert word in error


def test_a_study_is_drawn_by_content(tmp_path):
    study = lm.study(made(ODE), cells=[8, 16], gamma=[1.0, 1.01], starts=9)
    page = lm.plotting.study(study, tmp_path / "study.svg")
    assert len(page.axes) == 8  # two knobs, four quantities
    cost = page.axes[0]
    assert len(cost.get_lines()) == 2
    x, y = cost.get_lines()[0].get_data()
    np.testing.assert_allclose(x, [8, 16])
    np.testing.assert_allclose(y, [r.cost for r in study.rows if r.gamma == 1.0])
    assert (tmp_path / "study.svg").exists()
    with pytest.raises(lm.BadInput, match="ends in"):
        lm.plotting.study(study, tmp_path / "study.txt")
    with pytest.raises(lm.BadInput, match="not a Study"):
        lm.plotting.study("study.json")


def test_keys_tell_variants_apart(tmp_path):
    folder = keeping.Folder(tmp_path / "none", {"starts": 3})
    a, b = made(ODE), made({**ODE, "gamma": 1.1})
    assert folder.key(a, "highs") == keeping.Folder(tmp_path, {"starts": 3}).key(a, "highs")
    keys = {folder.key(a, "highs"), folder.key(b, "highs"), folder.key(a, "clarabel"),
            keeping.Folder(tmp_path, {"starts": 4}).key(a, "highs")}  # fmt: skip
    assert len(keys) == 4
    assert not (tmp_path / "none").exists()


def test_where_the_attractor_differs_no_order_is_told():
    """Cells within the declared box: 2/8, 4/16 and 10/32 of the axis are different problems."""
    sizes = ((8, 0.25), (16, 0.25), (32, 0.3125))
    rows = [row(cells={"x": n}, cost=3 + 1 / n, attractor=a) for n, a in sizes]
    (found,) = orders.orders(rows)
    assert (found.order, found.limit) == (None, None)
    assert "the attractor differs (25 %, 25 %, 31.25 % of the cells)" in str(found)
    assert str(found) in record.Study("x", tuple(rows), (found,)).table()
    (same,) = orders.orders([row(cells={"x": n}, cost=3 + 1 / n, attractor=0.25) for n, _ in sizes])
    assert same.order == pytest.approx(1.0, rel=1e-3)


def test_the_attractor_of_a_variant_is_told():
    box = {"boxes": [{"x": [0, 1.1]}]}
    found = running.study(made({**ODE, "attractor": box}), cells=[8, 16, 32], starts=0)
    assert [r.attractor for r in found.rows] == [0.25, 0.25, 8 / 32]
    other = running.study(made({**ODE, "attractor": box}), cells=[10, 20, 40], starts=0)
    assert [r.attractor for r in other.rows] == [2 / 10, 5 / 20, 11 / 40]
    assert "attractor differs" in other.table()

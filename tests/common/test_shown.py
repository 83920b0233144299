"""What notebooks show of objects, and which names they complete."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.common import html

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.json"))
HOSTILE = "<script>alert('&')</script><img src=x onerror=\"y\"> \x1b[31m"


def text(shown):
    """The text of HTML that is well formed and holds nothing but tables."""
    tree = ElementTree.fromstring(f"<body>{shown._repr_html_()}</body>")
    known = ["body", "div", "table", "caption", "thead", "tbody", "tr", "th", "td", "br", "pre"]
    assert {each.tag for each in tree.iter()} <= {*known, "p"}
    assert all(set(each.attrib) <= {"style"} for each in tree.iter())
    return " ".join(tree.itertext())


@pytest.fixture(scope="module")
def result():
    return lm.solve(made(standard_map(20, name=HOSTILE)))


def test_names_are_text(result):
    for shown in (result.problem, result.lp, result):
        assert "<script>alert('&')</script><img src=x onerror=\"y\"> \\x1b[31m" in text(shown)


def test_results_show_their_numbers(result):
    assert f"{result.cost:.9g} (lower bound {result.lower_bound:.9g})" in text(result)
    assert {"verified", "policy-iteration"} <= set(text(result).split())
    claims = text(result.certificate)
    assert f"contraction {result.contraction:.9g}" in claims
    assert claims.count("holds") == 4
    assert "not proved" not in claims
    assert f"{result.lp.K:,}" in text(result.lp)
    assert "8 attractor" in text(result.lp)
    runs = result.simulate(50, 100)
    assert f"{runs.reached}" in text(runs)
    assert runs.sentence() in text(runs)
    refused = lm.solve(made(standard_map(20, gamma=50.0)))
    assert "not_stabilizable" in text(refused)
    assert "gamma_bar" in text(refused)
    claims = text(refused.certificate)
    assert "refusal holds" in claims
    assert "not proved" in claims


def test_comparisons_show_their_table(result):
    found = lm.compare(result.lp, ["policy-iteration", "highs"])
    for word in ("policy-iteration", "highs", "gap before polish", "agreement: costs within"):
        assert word in text(found)
    assert str(found).splitlines()[-1] in text(found)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_problems_show_what_they_declare(path):
    problem = lm.load(path)
    words = text(problem)
    for name, axis in problem.state_box.items():
        assert f"{name} from {axis.low:g} to {axis.high:g}, {axis.cells:,} cells" in words
    for key in problem.model_fields_set - {"format", "name", "system", "state_box", "control_grid"}:
        if getattr(problem, key) != type(problem).model_fields[key].default:
            assert key in words
    if isinstance(problem.stage_cost, str):
        assert problem.stage_cost in words


def test_problems_without_formulas_are_shown():
    finite = lm.from_matrices([np.array([[0.5, 0.5], [0.0, 1.0]])], np.ones((2, 1)), [1])
    assert "a finite model" in text(finite)
    own = made(steps()).replaced(
        system=lm.systems.FunctionSystem(next=lambda x, u: {"x": x + u}), stage_cost=lambda x: x
    )
    assert text(own).count("a Python function") == 2
    held = lm.load(next(path for path in EXAMPLES if path.stem == "standard_map_held"))
    assert "kind: lqr" in text(held)
    weights = made(steps()).replaced(measure={"weights": [1.0] * 4})
    assert "weights: [1.0, 1.0, 1.0, 1.0]" in text(weights)


def test_reports_are_shown_as_they_are_printed(result, tmp_path):
    result.save(tmp_path / "out")
    trapped = made(steps(avoid={"boxes": [{"x": [0.5, 0.75]}]}, name=HOSTILE))
    for shown in (
        lm.check(result.problem), lm.verify(tmp_path / "out"), lm.gamma_max(result.lp),
        lm.explain(trapped), lm.solve(made(steps())).prove(),
    ):  # fmt: skip
        assert text(shown) == str(shown)
    assert text(result.controller) == str(result.controller) == repr(result.controller)
    assert str(result.controller).startswith("Controller of x, y: constant on each of ")
    assert result.coverage._repr_html_() == f"<pre>{result.coverage}</pre>"


def test_long_things_are_cut():
    rows = [("a" * 9_000, "b\nc")]
    assert len(html.facts(rows)) < 3_000
    assert "<br/>" in html.grid(("x",), [("b\nc",)], "title", "note")


def test_completion_offers_our_names_only(result):
    problem = result.problem
    for item in (problem, problem.state_box["x"], problem.system, problem.sampling, lm.Problem):
        names = {name for name in dir(item) if not name.startswith("_")}
        assert names
        assert not names & {"copy", "dict", "json", "schema", "parse_obj", "model_dump", "validate"}
        assert {name for name in names if name.startswith("model_")} <= {
            "model_validate", "model_json_schema",
        }  # fmt: skip
    for name in dir(problem):
        if not name.startswith("__"):
            assert hasattr(problem, name)
    assert {*lm.Problem.model_fields, "replaced", "save", "to_dict", "states"} <= set(dir(problem))
    assert "__class__" in dir(problem)


def test_what_completes_names_in_notebooks_gets_along_with_all_of_them(result):
    """It runs into errors of its own, and offers nothing, at some types of properties."""
    jedi = pytest.importorskip("jedi")
    objects = {
        "problem": result.problem, "axis": result.problem.state_box["x"], "lp": result.lp,
        "system": result.problem.system, "result": result, "certificate": result.certificate,
        "controller": result.controller, "runs": result.simulate(5, 5), "lm": lm,
        "partition": result.partition, "check": lm.check(made(steps())),
    }  # fmt: skip
    for name, item in objects.items():
        found = {each.name for each in jedi.Interpreter(f"{name}.", [objects]).complete()}
        assert {each for each in dir(item) if not each.startswith("_")} <= found, name

"""Named subexpressions, conditions and suggestions in problem files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm

LET = {"half": "u/2", "down": "x - half/2", "far": "x + k"}
SYSTEM = {"kind": "map", "parameters": {"k": 0.5}, "next": {"x": "down"}}


def declared(**more):
    return {**steps(), "system": SYSTEM, "let": LET, **more}


def test_it_is_as_if_written_out():
    short = made(declared(stage_cost="far + half", measure={"density": "far**2"}))
    long = made(steps(cost="(x + 0.5) + (u/2)", measure={"density": "(x + 0.5)**2"})).replaced(
        system=lm.systems.MapSystem(next={"x": "x - (u/2)/2"})
    )
    first, second = lm.compile(short), lm.compile(long)
    np.testing.assert_array_equal(first.cost, second.cost)
    np.testing.assert_array_equal(first.weight, second.weight)
    np.testing.assert_array_equal(first.rows.target, second.rows.target)
    assert first.digest == second.digest


def test_a_file_keeps_what_was_written(tmp_path):
    problem = made(declared(stage_cost="far"))
    saved = problem.to_dict()
    assert saved["let"] == LET
    assert list(saved["let"]) == list(LET)
    assert saved["stage_cost"] == "far"
    problem.save(tmp_path / "p.json")
    assert lm.load(tmp_path / "p.json") == problem
    result = lm.solve(problem)
    result.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds
    assert "let" not in made(steps()).to_dict()


def test_in_differential_equations_and_beside_named_systems():
    ode = {"kind": "ode", "derivative": {"x": "push - x"}, "step": 0.5}
    plain = {"kind": "ode", "derivative": {"x": "(u - 1) - x"}, "step": 0.5}
    first = lm.compile(made(steps(system=ode, let={"push": "u - 1"})))
    assert first.digest == lm.compile(made(steps(system=plain))).digest
    named = standard_map(10, let={"r": "x**2 + y**2", "K2": "K*2"}, stage_cost="r + u**2 + 0*K2")
    other = standard_map(10, stage_cost="x**2 + y**2 + u**2 + 0*(K*2)")
    assert lm.compile(made(named)).digest == lm.compile(made(other)).digest
    own = made(standard_map(10)).replaced(
        system=lm.systems.FunctionSystem(next=lambda x, y, u: (x, y + u)),
        let={"r": "x"}, stage_cost="r",
    )  # fmt: skip
    assert lm.compile(own).cost.size


def test_one_way_in_which_formulas_are_parsed():
    problem = made(declared())
    assert problem.formula("far + x", "somewhere", ("state",)).names == {"x", "k"}
    assert problem.formula("half < 1", "somewhere", condition=True).names == {"u"}
    for text, kinds, says in [
        ("u", ("state",), "somewhere: character 1: 'u' is a control, which has no value"),
        ("half", ("state",), "somewhere: character 1: 'half' depends on u, which has no value"),
        ("x < 1", ("state",), "comparison"),
    ]:
        with pytest.raises(lm.BadInput, match=says):
            problem.formula(text, "somewhere", kinds)


@pytest.mark.parametrize(
    ("change", "where", "says"),
    [
        ({"let": {"x": "1"}}, "let", "'x' is also used in state_box"),
        ({"let": {"u": "1"}}, "let", "control_grid"),
        ({"let": {"k": "1"}}, "let", "system.parameters"),
        ({"let": {"sin": "1"}}, "let", "'sin' has a meaning"),
        ({"let": {"a b": "1"}}, "let", "not a name"),
        ({"let": {"a": 1}}, "let.a", "write a string"),
        ({"let": {"a": "b", "b": "x"}}, "let.a", "move it up in let"),
        ({"let": {"a": "w"}}, "let.a", "'w' is not a declared name"),
        ({"let": ["a"]}, "let", ""),
        ({"let": {f"a{k}": "x" for k in range(201)}}, "let", "200"),
        ({"measure": {"density": "half"}}, "measure.density", "'half' depends on u"),
        ({"attractor": {"where": "half < 1"}}, "attractor.where", "'half' depends on u"),
        ({"attractor": {"where": "u < 1"}}, "attractor.where", "'u' is a control"),
        ({"attractor": {"where": "x"}}, "attractor.where", "'x' is not a comparison"),
        ({"attractor": {"where": []}}, "attractor.where", "at least 1"),
        ({"attractor": {"where": ["x < 1", "x <"]}}, "attractor.where[1]", "ends"),
        ({"attractor": {"where": ["x < 1"] * 101}}, "attractor.where", "100"),
        ({"attractor": {"where": "x < 0.1"}}, "attractor.where", "on no cell as a whole"),
        ({"attractor": {"where": 1}}, "attractor.where", "string"),
        ({"attractor": {"where": [1]}}, "attractor.where[0]", "string"),
        ({"avoid": {"where": "x < 0.1"}}, "avoid", "both attractor and avoid"),
        ({"avoid": {}}, "avoid", "give boxes or where"),
        ({"measure": {"where": "x < 0.1"}}, "measure.where", "on no cell"),
        ({"admissible": "u + 1"}, "admissible", "is not a comparison"),
        ({"admissible": "z < 1"}, "admissible", "'z'"),
        ({"statebox": 1}, "statebox", "did you mean 'state_box'"),
        ({"cost": "1"}, "cost", "did you mean 'stage_cost'"),
        ({"controls": {}}, "controls", "did you mean 'control_grid'"),
        ({"system": {"kind": "MAP", "next": {"x": "x"}}}, "system.kind", "did you mean 'map'"),
        ({"system": {"kind": "ODE"}}, "system.kind", "did you mean 'ode'?"),
        ({"system": {"kind": "standardmap"}}, "system.kind", "mean 'standard_map'"),
        ({"system": {"kind": "continuous"}}, "system.kind", "did you mean 'ode'?"),
        ({"system": {"kind": 7}}, "system.kind", "7 is not a kind; the kinds are map, ode, "),
        ({"system": "map"}, "system", "write an object with a kind: map, ode, "),
        ({"system": {**SYSTEM, "derivative": {}}}, "system.derivative", "a map has no derivative"),
        ({"attractor": {"boxes": [{"X": [0, 1]}]}}, "attractor.boxes[0]", "did you mean 'x'?"),
        ({"noise": {"w": {"gaussian": {"std": 1, "points": 3}}}}, "noise.w.gaussian", "'normal'"),
        ({"noise": {"w": {"normal": {"sigma": 1, "points": 3}}}}, "noise.w.normal.sigma", "'std'"),
        (
            {"control_grid": {"u": {"min": 0, "high": 1, "points": 2}}},
            "control_grid.u.min",
            "'low'",
        ),
        ({"control_grid": {"u": {"value": [0]}}}, "control_grid.u.value", "'values'"),
        ({"stage_cost": "arcsin(x)"}, "stage_cost", "did you mean 'asin'?"),
        ({"stage_cost": "farr"}, "stage_cost", "did you mean 'far'?"),
    ],
)
def test_refusals_and_suggestions(change, where, says):
    with pytest.raises(lm.BadInput) as caught:
        lm.compile(made(declared(**change)))
    assert str(caught.value).startswith(f"{where}: ")
    assert says in str(caught.value)
    assert len(str(caught.value)) < 600


def test_backends_and_systems_are_suggested():
    with pytest.raises(lm.BadInput, match=r"did you mean 'highs'\?"):
        lm.solve(made(steps()), backend="HiGHS")
    with pytest.raises(lm.BadInput, match=r"did you mean 'policy-iteration'\?"):
        lm.solve(made(steps()), backend="policy_iteration")


def test_a_hostile_let_is_refused_soon():
    """200 definitions of the greatest length, each of which uses all others."""
    names = [f"a{k}" for k in range(200)]
    let = {n: "+".join(["x", *names[:k]] + ["x"] * (499 - k)) for k, n in enumerate(names)}
    with pytest.raises(lm.BadInput, match="the limit is 10,000"):
        made(steps(cost="a199", let=let))
    problem = made(steps(cost="a9", let=let))
    assert json.loads(json.dumps(problem.to_dict()))["let"] == let

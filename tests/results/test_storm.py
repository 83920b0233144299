"""The model for Storm is the model, and Storm finds the same values."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from certificate_files import noisy, parsed
from model_checker import COSTS, PRECISION, answer, built, newer, package, read, written
from models import random_lp
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.results.exports import export_drn


def value_iteration(states, sweeps):
    """Least expected total cost until the last state, from below, in plain floats."""
    rows = [[(float(c), [(j, float(p)) for j, p in row.items()]) for _, c, row in actions]
            for actions in states[:-1]]  # fmt: skip
    V = [0.0] * len(states)
    for _ in range(sweeps):
        for i, actions in enumerate(rows):
            V[i] = min(c + sum(p * V[j] for j, p in row) for c, row in actions)
    return V


AT_ONE = {
    "steps": steps(),
    "steps, uneven": steps(cost="0.1 + x"),
    "doubling": doubling(),
    "standard map": standard_map(12, 1.0),
    "noise": noisy(),
    "part of m": noisy(measure={"boxes": [{"x": [0.5, 1.0]}]}),
}


@pytest.fixture(params=AT_ONE)
def at_one(request, tmp_path):
    result = lm.solve(made(AT_ONE[request.param]))
    assert result.status == "verified"
    export_drn(result.lp, tmp_path / "model.drn")
    return result, tmp_path / "model.drn"


@pytest.mark.long
def test_the_model_for_storm_is_the_model(at_one):
    result, path = at_one
    lp = result.lp
    labels, states = parsed(path)
    assert len(states) == lp.n + 1
    assert labels[-1] == ["attractor"]
    assert [names == ["init"] for names in labels[:-1]] == [m > 0 for m in lp.weight]
    assert states[-1] == [("stay", 0, {lp.n: 1})]
    found = [(int(name), cost) for actions in states[:-1] for name, cost, _ in actions]
    assert found == [(int(a), Fraction(float(c))) for a, c in zip(lp.control, lp.cost, strict=True)]
    for actions in states:
        assert all(sum(row.values()) == 1 for _, _, row in actions)
        assert all(p > 0 for _, _, row in actions for p in row.values())
    V = value_iteration(states, 1000)
    np.testing.assert_allclose(V[:-1], result.value[lp.cells], rtol=1e-9)


def test_what_storm_cannot_hold_is_refused(tmp_path):
    with pytest.raises(lm.BadInput, match=r"gamma: 1.02 .* gamma = 1") as caught:
        export_drn(lm.compile(made(steps(1.02))), tmp_path / "file")
    assert caught.value.where == "gamma"
    nowhere = steps(system={"kind": "map", "next": {"x": "x + 0*u"}})
    with pytest.raises(lm.BadInput, match="empty"):
        export_drn(lm.compile(made(nowhere)), tmp_path / "file")
    lp = lm.compile(made(steps()))
    with pytest.raises(lm.BadInput, match="initial"):
        export_drn(replace(lp, weight=np.zeros(lp.n)), tmp_path / "file")
    assert not list(tmp_path.iterdir())


def storm_values(path, exact=False, question=COSTS):
    """The least expected cost of every state, by Storm."""
    model = read(path, exact)
    return model, answer(model, question, exact)


def test_storm_agrees(at_one):
    result, path = at_one
    lp = result.lp
    model, values = storm_values(path)
    assert (model.nr_states, model.nr_choices) == (lp.n + 1, lp.K + 1)
    assert list(model.initial_states) == list(np.flatnonzero(lp.weight))
    assert values[-1] == 0
    np.testing.assert_allclose(values[:-1], result.value[lp.cells], rtol=PRECISION)


def test_storm_in_rational_arithmetic_lies_between_the_bounds(at_one):
    """Nothing is rounded anywhere: Storm's exact V obeys W <= V <= V_up in every cell."""
    result, path = at_one
    _, values = storm_values(path, exact=True)
    on = result.lp.cells
    for V, lower, upper in zip(values[:-1], result.lower[on], result.value[on], strict=True):
        assert Fraction(float(lower)) <= V <= Fraction(float(upper))


@pytest.mark.parametrize("zero", [0.0, 0.4])
def test_storm_agrees_on_random_models(zero, tmp_path):
    """With zeros in the cost a free stay must not look better than going."""
    rng = np.random.default_rng(8)
    for _ in range(20):
        result = lm.solve(random_lp(rng, cells=12, zero=zero))
        assert result.status == "verified"
        if not result.lp.cost.any():
            continue
        export_drn(result.lp, tmp_path / "model.drn")
        _, values = storm_values(tmp_path / "model.drn")
        np.testing.assert_allclose(
            values[:-1], result.value[result.lp.cells], rtol=PRECISION, atol=1e-9
        )


def test_storm_agrees_where_runs_end_by_discount(tmp_path):
    result = lm.solve(made({**noisy(), "discount": 0.9}))
    export_drn(result.lp, tmp_path / "model.drn")
    question = 'R{"cost"}min=? [F "attractor" | "ended"]'
    _, values = storm_values(tmp_path / "model.drn", question=question)
    assert values[-2:] == [0, 0]
    np.testing.assert_allclose(values[:-2], result.value[result.lp.cells], rtol=PRECISION)


# Models of Storm's ----------------------------------------------------------------------------

# Two dice of fair coins (Knuth, Yao), thrown in any order: the known mean is 22/3.
DICE = """mdp
module one
  s : [0..7] init 0;
  [] s=0 -> 0.5 : (s'=1) + 0.5 : (s'=2);
  [] s=1 -> 0.5 : (s'=3) + 0.5 : (s'=4);
  [] s=2 -> 0.5 : (s'=5) + 0.5 : (s'=6);
  [] s=3 -> 0.5 : (s'=1) + 0.5 : (s'=7);
  [] s=4 | s=5 -> 1 : (s'=7);
  [] s=6 -> 0.5 : (s'=2) + 0.5 : (s'=7);
endmodule
module two = one [s=t] endmodule
rewards "flips"
  [] true : 1;
endrewards
label "goal" = s=7 & t=7;
"""

# Rewards without a name, of states and of actions, named actions, thirds, a way of no return.
WALK = """mdp
module walker
  x : [0..9] init 3;
  [slow] x>0 & x<7 -> 2/3 : (x'=x+1) + 1/3 : (x'=x-1);
  [fast] x>0 & x<6 -> 3/7 : (x'=x+2) + 4/7 : (x'=x-1);
  [jump] x=2 -> 1/2 : (x'=7) + 1/2 : (x'=8);
  [back] x=0 -> 1 : (x'=1);
  [lost] x=8 -> 1 : (x'=9);
  [lost] x=9 -> 1 : (x'=8);
endmodule
rewards
  x<7 : 1/2;
  [fast] true : 0.3;
  [back] true : 5;
endrewards
label "goal" = x=7;
"""

# A chain: a gambler with a fair coin leaves with 6 or with nothing, after x (6 - x) throws.
GAMBLER = """dtmc
module gambler
  x : [0..6] init 2;
  [] x>0 & x<6 -> 1/2 : (x'=x+1) + 1/2 : (x'=x-1);
  [] x=0 | x=6 -> true;
endmodule
rewards "throws"
  x>0 & x<6 : 1;
endrewards
label "goal" = x=0 | x=6;
"""

# Of PRISM's benchmarks, as they come with stormpy: reward model, label of the goal, the answer.
SHIPPED = {
    "mdp/two_dice.nm": ("coinflips", "done", Fraction(22, 3)),
    "mdp/coin2-2.nm": ("steps", "finished", 48),
    "mdp/csma2_2.nm": ("time", "all_delivered", Fraction(53954981353, 805306368)),
    "mdp/maze_2.nm": (None, "goal", Fraction(66, 13)),
    "dtmc/leader3_5.pm": ("num_rounds", "elected", Fraction(25, 24)),
}
OURS = {
    "dice": (DICE, "flips", Fraction(22, 3)),
    "walk": (WALK, None, None),
    "gambler": (GAMBLER, "throws", 8),
}


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("name", [*OURS, *SHIPPED])
def test_a_model_of_prism_goes_there_and_back(name, exact, tmp_path):
    """PRISM's language -> Storm -> DRN -> lmdsl -> DRN -> Storm: one least cost in all states."""
    if name in OURS:
        text, reward, known = OURS[name]
        program, goal = tmp_path / "program.nm", "goal"
        program.write_text(text)
    else:
        reward, goal, known = SHIPPED[name]
        program = Path(package().__file__).parent / "examples/files" / name
    model = built(program, exact)
    named = f'{{"{reward}"}}' * (reward is not None)
    theirs = answer(model, f'R{named}min=? [F "{goal}"]', exact)
    written(model, tmp_path / "theirs.drn")

    result = lm.solve(lm.from_matrices(tmp_path / "theirs.drn", reward, targets=goal))
    assert result.status == "verified"
    plain = np.array([float(v) for v in theirs])
    # Storm rounds probabilities to ten digits where it writes doubles.
    np.testing.assert_allclose(result.value, plain, rtol=1e-8 if exact else PRECISION, atol=1e-12)
    (start,) = model.initial_states
    assert result.cost == pytest.approx(plain[start], rel=1e-8 if exact else PRECISION)
    if known is not None:
        assert result.cost == pytest.approx(float(known), rel=1e-8)
    if exact:
        for V, lower, upper in zip(theirs, result.lower, result.value, strict=True):
            assert V == upper == np.inf or Fraction(float(lower)) <= V <= Fraction(float(upper))

    export_drn(result.lp, tmp_path / "ours.drn")
    exact &= newer()  # which alone reads exact DRN files
    again, values = storm_values(tmp_path / "ours.drn", exact)
    lp = result.lp
    assert list(again.initial_states) == np.flatnonzero(lp.weight).tolist()
    if exact:
        assert values[:-1] == [theirs[cell] for cell in lp.cells]
    else:
        np.testing.assert_allclose(values[:-1], plain[lp.cells], rtol=PRECISION, atol=1e-12)

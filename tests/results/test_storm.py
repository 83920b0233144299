"""The model for Storm is the model, and Storm finds the same values."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from certificate_files import noisy, parsed
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


PRECISION = 1e-6
"""Storm's stated default, relative to the value; a bound of the error with sound methods only."""


def storm_values(path, exact=False):
    """The least expected cost of every state by Storm, whose interface changed with version 2."""
    stormpy = pytest.importorskip("stormpy", reason="Storm is not installed")
    property_ = stormpy.parse_properties('R{"cost"}min=? [F "attractor"]')[0]
    if exact:
        if not hasattr(stormpy, "Rational") or not hasattr(stormpy, "environments"):
            pytest.skip("this version of stormpy reads DRN files as doubles only")
        model = stormpy.build_model_from_drn[stormpy.Rational](str(path))
    else:
        model = stormpy.build_model_from_drn(str(path))
    if hasattr(stormpy, "environments"):  # sound, or exact for an exact model, by default
        found = stormpy.model_checking(model, property_)
    else:
        environment = stormpy.Environment()
        environment.solver_environment.set_force_sound(True)
        found = stormpy.model_checking(model, property_, environment=environment)
    values = found.get_value_vector() if hasattr(found, "get_value_vector") else found.get_values()
    return model, [Fraction(str(v)) if exact else float(v) for v in values]


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

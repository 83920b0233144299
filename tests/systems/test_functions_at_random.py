"""Random problems in four ways: formulas, arrays, one sample at a time, and through SymPy."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made
from random_problems import random_problem

import lmdsl as lm
from lmdsl.systems import FunctionSystem, MapSystem, from_sympy

SEEDS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 11]


def drawn(seed):
    """A random problem whose steps are judged at their ends, as those of functions are."""
    data = random_problem(np.random.default_rng(seed))
    if data["system"]["kind"] == "ode":
        data["system"]["judged"] = "endpoint"
    return made(data)


def called(plain, vectorized):
    """The problem with its map and its cost as functions; parameters are given to both."""
    step, cost, names = plain.step(), plain.stage(), set(plain.system.constants())

    def image(**values):
        given = {name: value for name, value in values.items() if name not in names}
        return [x if vectorized else float(x) for x in step(given)]

    def paid(**values):
        given = {name: value for name, value in values.items() if name not in names}
        (found,) = cost(given)
        return found if vectorized else float(found)

    system = FunctionSystem(
        next=image, vectorized=vectorized, parameters=dict(plain.system.constants())
    )
    return plain.replaced(system=system, stage_cost=paid)


@pytest.mark.parametrize("seed", SEEDS)
def test_functions_compile_to_the_model_of_formulas(seed):
    plain = drawn(seed)
    wanted = lm.compile(plain)
    for vectorized in (True, False):
        found = lm.compile(called(plain, vectorized))
        np.testing.assert_array_equal(found.cell_status, wanted.cell_status)
        np.testing.assert_array_equal(found.control, wanted.control)
        np.testing.assert_array_equal(found.rows.target, wanted.rows.target)
        np.testing.assert_array_equal(found.rows.code, wanted.rows.code)
        np.testing.assert_allclose(found.cost, wanted.cost, rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_formulas_survive_the_way_through_sympy(seed):
    sp = pytest.importorskip("sympy")
    plain = drawn(seed)
    system = plain.system
    texts = dict(
        system.next if isinstance(system, MapSystem) else getattr(system, "derivative", {})
    )
    if not texts or any(
        word in " ".join(texts.values()) for word in ("where", "sign", "min", "max")
    ):
        pytest.skip("a named system, or functions that SymPy calls otherwise")
    names = {*plain.states, *plain.controls, *plain.noises, *system.constants()}
    symbols = {name: sp.Symbol(name) for name in names}
    expressions = {name: sp.sympify(text, symbols, rational=False) for name, text in texts.items()}
    time = (
        {} if isinstance(system, MapSystem) else {"step": system.step, "substeps": system.substeps}
    )
    own = from_sympy(expressions, dict(system.parameters), **time)
    if time:
        own = own.replaced(judged="endpoint")
    wanted, found = lm.compile(plain), lm.compile(plain.replaced(system=own))
    np.testing.assert_array_equal(found.cell_status, wanted.cell_status)
    np.testing.assert_array_equal(found.rows.target, wanted.rows.target)

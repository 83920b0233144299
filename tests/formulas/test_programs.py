"""Formulas compiled together: shared, in little memory, to the same bits."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from formula_texts import NAMES, Oracle, same_bits, value
from spent import at_most

from lmdsl.errors import BadInput
from lmdsl.formulas import operations
from lmdsl.formulas.language import Formula, parse
from lmdsl.formulas.operations import FORMULA_FUNCTIONS
from lmdsl.formulas.program import Program

STANDARD_MAP = ("x + y + K*u*sin(2*pi*x)", "y + K*u*sin(2*pi*x)")


def program(*texts, constants=None, names=(*NAMES, "K")):
    return Program([parse(text, names) for text in texts], constants or {})


def counting(monkeypatch, name):
    shapes = []
    original = operations.OPERATIONS[name]

    def counted(*arguments, **keywords):
        result = original(*arguments, **keywords)
        shapes.append(np.shape(result))
        return result

    monkeypatch.setitem(operations.OPERATIONS, name, counted)
    return shapes


def test_equal_steps_are_evaluated_once_and_in_the_smallest_shape(monkeypatch):
    compiled = program(*STANDARD_MAP, constants={"K": 0.25})
    assert compiled.names == {"u", "x", "y"}
    assert compiled.operations == ("+", "*", "*", "sin", "*", "+", "+")
    sines, products = counting(monkeypatch, "sin"), counting(monkeypatch, "*")
    x, y, u = np.ones((7, 1, 5)), np.ones((7, 1, 5)), np.ones((1, 3, 1))
    first, second = compiled({"x": x, "y": y, "u": u})
    assert sines == [(7, 1, 5)]
    assert products == [(1, 3, 1), (7, 1, 5), (7, 3, 5)]
    assert first.shape == second.shape == (7, 3, 5)


def test_sharing_is_to_the_bit_and_reorders_nothing():
    assert program("x*y", "y*x").operations == ("*", "*")
    assert program("x+y+u", "x+(y+u)").operations == ("+", "+", "+", "+")
    assert program("x*0", "x*(-0.0)", "x*0.0").operations == ("*", "*")
    assert program("sin(x)", "sin((x))", "+sin(x)").operations == ("sin",)
    assert program("x*(K/3)", "x*(1/3)", constants={"K": 1}).operations == ("*",)
    assert program("1/3 + 2*pi").operations == ()
    assert program("where(x<1,x,y) + where(x<1,x,y)").operations == ("<", "where", "+")
    zero, minus = program("x*0", "x*(-0.0)")({"x": np.ones(1)})
    assert np.signbit(minus)
    assert not np.signbit(zero)


def test_square_is_a_product_and_other_powers_are_powers():
    x = np.random.default_rng(0).normal(size=10_001) * 1e3
    assert same_bits(value("x**2", x=x), x * x)
    assert same_bits(value("x**2.0", x=x), x * x)
    assert same_bits(value("x**K", {"K": 2}, x=x), x * x)
    assert same_bits(value("x**-(-2)", x=x), x * x)
    for exponent in (0.5, 3.0, -1.0, 0.0):
        with np.errstate(invalid="ignore"):
            assert same_bits(value(f"x**{exponent}", x=x), np.power(x, exponent))


@pytest.mark.parametrize("name", sorted(FORMULA_FUNCTIONS))
def test_long_arrays_of_temporaries_have_the_bits_of_fresh_ones(name):
    x, y = np.random.default_rng(1).normal(size=(2, 4099)) * 3
    arguments = {1: "x*y", 2: "x*y, x-y", 3: "x*y < x-y, x/y, x+y"}[FORMULA_FUNCTIONS[name]]
    text = f"-(({name}({arguments}) + x*y)/(x+1) - sqrt(abs(x*2 - 1)))*floor(x*3)**2"
    expected = Oracle({"x": x, "y": y})(text)
    assert same_bits(value(text, x=x, y=y), expected)
    strided = np.repeat(x, 3)[::3]
    assert same_bits(value(text, x=strided, y=y), expected)


def test_memory_of_a_dead_temporary_is_used_again(monkeypatch):
    targets = []
    original = np.add

    def watched(*arguments, out=None):
        targets.append(out is not None)
        return original(*arguments, out=out)

    monkeypatch.setitem(operations.OPERATIONS, "+", watched)
    x, y = np.ones((4, 1)), np.ones((1, 3))
    program("x + 1 + 2 + y + x")({"x": x, "y": y})
    # an input is never the target; then a temporary; then one too small; then one that fits
    assert targets == [False, True, False, True]
    targets.clear()
    first, second = program("x + 1", "(x + 1) + 2")({"x": x})
    assert targets == [False, False]  # the first result is kept
    assert (first[0], second[0]) == (2, 4)


def test_inputs_may_be_read_only_integers_scalars_and_broadcast_views():
    x = np.broadcast_to(np.arange(3), (4, 3))
    frozen = np.ones(3)
    frozen.flags.writeable = False
    results = program("x", "y", "x*y", "u", "u*2", "7", "-y", "y")({"x": x, "y": frozen, "u": 3})
    assert [array.shape for array in results] == [(4, 3), (3,), (4, 3), (), (), (), (3,), (3,)]
    assert all(isinstance(array, np.ndarray) and array.dtype == np.float64 for array in results)
    for array in results:
        array += 1
    assert frozen.tolist() == [1, 1, 1]
    assert x[0].tolist() == [0, 1, 2]


def test_a_program_is_used_many_times_without_memory_of_the_last():
    compiled = program("x + K*sin(x) + K", constants={"K": 2.0})
    for size in (3, 1, 5):
        x = np.linspace(0, 1, size)
        expected = x + 2.0 * np.sin(x) + 2.0
        assert same_bits(compiled({"x": x})[0], expected)
        assert same_bits(compiled({"x": x, "unused": np.ones(9)})[0], expected)


def test_a_missing_name_is_named():
    with pytest.raises(BadInput, match="no value is given for u, y;"):
        program("x + y + u")({"x": 1.0})


def test_parameters_may_make_what_is_not_finite():
    assert np.isposinf(program("1/K", constants={"K": 0})({})[0])
    assert np.isnan(program("x*log(K)", constants={"K": -1})({"x": np.ones(2)})[0]).all()
    assert program("where(K > 0, x/K, x)", constants={"K": 0})({"x": 3.0})[0] == 3


def test_formula_keeps_its_text_and_pickles():
    formula = parse(" x + K ", ("x", "K", "y"))
    assert (formula.text, formula.names) == (" x + K ", {"x", "K"})
    assert pickle.loads(pickle.dumps(formula)) == formula
    assert isinstance(formula, Formula)
    compiled = pickle.loads(pickle.dumps(Program([formula], {"K": 1.0})))
    assert compiled({"x": 2.0})[0] == 3


def test_a_no_op_formula_list_is_fine():
    assert Program([])({}) == ()


def test_a_large_program_compiles_and_runs_in_bounded_work():
    text = "+".join(f"sin({k}*x)" for k in range(199))  # 995 nodes
    with at_most(20):
        compiled = Program([parse(text, NAMES)] * 20)
        assert len(compiled.operations) == 199 * 2 + 198
        compiled({"x": np.ones(10)})

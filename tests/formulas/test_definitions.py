"""Named subexpressions: written out, each once, to the same bits as the long text."""

from __future__ import annotations

import numpy as np
import pytest
from formula_texts import same_bits
from spent import at_most

from lmdsl.errors import BadInput
from lmdsl.formulas.language import MAX_WRITTEN, FormulaError, define, parse, parse_condition
from lmdsl.formulas.program import Program

NAMES = ("x", "y", "u", "K")
TEXTS = {"r": "sqrt(x**2 + y**2)", "s": "sin(r)*K", "two": "1 + 1", "d": "4/3 - s*r**two"}
LONG = {
    "r": "(sqrt(x**2 + y**2))", "s": "(sin(sqrt(x**2 + y**2))*K)", "two": "(1 + 1)",
    "d": "(4/3 - (sin(sqrt(x**2 + y**2))*K)*(sqrt(x**2 + y**2))**(1 + 1))",
}  # fmt: skip
VALUES = {"x": np.linspace(-2, 3, 50), "y": np.linspace(1, 2, 50), "u": np.full(50, 0.3)}


@pytest.mark.parametrize(
    "text", ["d", "d + r", "r + u*d - s", "x**two + d", "where(d > r, s, u)", "-r", "mod(d, r)"]
)
def test_it_is_as_if_written_out(text):
    long = text
    for name, by in LONG.items():
        long = "".join(by if word == name else word for word in split(long))
    short = parse(text, NAMES, define(TEXTS, NAMES))
    assert short.text == text
    assert short.names == parse(long, NAMES).names
    for formulas in ([short], [short, short]):
        program = Program(formulas, {"K": 1.5})
        other = Program([parse(long, NAMES)] * len(formulas), {"K": 1.5})
        assert sorted(program.operations) == sorted(other.operations)
        assert same_bits(program(VALUES)[-1], other(VALUES)[-1])


def split(text):
    import re

    return re.findall(r"\w+|\W", text)


def test_conditions_use_them():
    found = Program([parse_condition("d < r and not s > 0", NAMES, define(TEXTS, NAMES))], {"K": 1})
    r = np.sqrt(VALUES["x"] ** 2 + VALUES["y"] ** 2)
    s = np.sin(r)
    assert (found(VALUES)[0] == ((4 / 3 - s * r**2 < r) & ~(s > 0))).all()


def test_a_chain_that_doubles_costs_its_length():
    """Written out in full the last would have 2^40 terms."""
    texts = {"a0": "x + 1"} | {f"a{k}": f"a{k - 1} + a{k - 1}" for k in range(1, 41)}
    with at_most(5):
        formula = parse("a40", NAMES, define(texts, NAMES))
        assert len(formula.subformulas) < 50
        program = Program([formula])
        assert program.effort == 41
        assert program({"x": 1.0})[0] == 2.0**41


def test_the_limit_of_what_is_written_out():
    big = "+".join(["x"] * 500)
    texts = {f"b{k}": big for k in range(20)}
    most = MAX_WRITTEN // 999
    used = define(texts, NAMES)
    parse("+".join(f"b{k}" for k in range(most - 1)), NAMES, used)
    with pytest.raises(FormulaError, match=r"with its definitions in let .* the limit is 10,000"):
        parse("+".join(f"b{k}" for k in range(most + 1)), NAMES, used)
    chained = {f"c{k}": big[2:] + (f"+c{k - 1}" if k else "+x") for k in range(20)}
    with pytest.raises(FormulaError, match="the limit is 10,000"):
        parse("c19", NAMES, define(chained, NAMES))
    parse("c5", NAMES, define(chained, NAMES))


def test_what_is_refused():
    for texts, where, says in [
        ({"a": "b", "b": "x"}, "a", "'b' is not defined before; move it up"),
        ({"a": "a + 1"}, "a", "'a' is not defined before"),
        ({"a": "x", "b": "a + z"}, "b", "'z' is not a declared name .* a, "),
        ({"a": "x < 1"}, "a", "comparison"), ({"a": ""}, "a", "empty"),
        ({"a": "1/0"}, "a", "infinite"), ({"zero": "0", "b": "1/zero"}, "b", "'1/zero' is inf"),
        ({"radius": "x", "b": "radios"}, "b", "did you mean 'radius'"),
    ]:  # fmt: skip
        with pytest.raises(BadInput, match=says) as caught:
            define(texts, NAMES)
        assert caught.value.where == where
    used = define({"a": "x*u", "b": "a + 1", "c": "K"}, NAMES)
    with pytest.raises(FormulaError, match="'b' depends on u, which has no value here; declared"):
        parse("x + b", ("x", "y", "K"), used)
    parse("x + c", ("x", "K"), used)
    with pytest.raises(FormulaError, match="infinite"):
        parse("1/zero", NAMES, define({"zero": "0"}, NAMES))

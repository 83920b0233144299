"""What was probably meant: the nearest name, and what people write for ours."""

from __future__ import annotations

import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.common import spelling
from lmdsl.formulas.operations import FORMULA_CONSTANTS, FORMULA_FUNCTIONS
from lmdsl.formulas.parser import Parser
from lmdsl.formulas.tokens import HABITS, FormulaError
from lmdsl.problem import noise

KNOWN = ("state_box", "stage_cost", "cells", "policy-iteration", "x", "sin", "log")


@pytest.mark.parametrize(("written", "meant"), [
    ("statebox", "state_box"), ("state-box", "state_box"), ("STATE_BOX", "state_box"),
    ("cell", "cells"), ("policy_iteration", "policy-iteration"), ("X", "x"), ("sinn", "sin"),
    ("y", None), ("zzz", None), ("", None), ("x" * 100_000, None), ("ln", "log"), ("Ln", "log"),
    ("arcsin", None),
])  # fmt: skip
def test_nearest(written, meant):
    assert spelling.nearest(written, KNOWN, {"ln": "log", "arcsin": "asin"}) == meant


def test_hints_end_a_message():
    assert spelling.hint("cell", KNOWN) == "; did you mean 'cells'?"
    assert spelling.hint("pow", KNOWN, HABITS) == "; write x**y"
    assert spelling.hint("zzz", KNOWN) == spelling.hint(3, KNOWN) == ""
    assert spelling.hint("arcsin", KNOWN, HABITS) == ""  # asin is not known here


def test_every_habit_leads_to_what_is_known():
    """Names lead to functions, and expressions parse."""
    for written, meant in HABITS.items():
        assert written not in FORMULA_FUNCTIONS
        assert written == written.lower().replace("_", "")
        if meant.isidentifier():
            assert meant in {*FORMULA_FUNCTIONS, *FORMULA_CONSTANTS}, written
        else:
            Parser(meant, {"x", "y", "a", "b"}, {}, condition=meant in ("1 < 2", "1 > 2"))


def test_every_key_that_is_suggested_exists():
    keys = {*lm.Problem.model_fields}
    models = [*vars(lm.systems).values(), *vars(lm.problem).values(), noise.Normal]
    for model in models:
        keys.update(getattr(model, "model_fields", {}))
    assert set(spelling.KEYS.values()) - keys == set()
    kinds = {"ode", "map", "grid", "random", "sobol", "linear"}
    assert set(spelling.KINDS.values()) <= kinds
    assert not {*spelling.KEYS} & {*lm.Problem.model_fields}


def test_points():
    for point, says in [({"X": 0}, "; is 'x' meant by 'X'?"), ({"y": 0}, "once: x"), ({}, "once")]:
        with pytest.raises(lm.BadInput) as caught:
            made(steps(attractor={"points": [point]}))
        assert str(caught.value).endswith(says) or says in str(caught.value)


@pytest.mark.parametrize("text", ["arcsin(x)", "np.sin(x)", "ln(x)", "x^2", "x % 2", "|x|", "Pi",
                                  "pow(x, 2)", "x = 1", "numpy.mod(x, 1)"])  # fmt: skip
def test_every_message_says_what_to_write(text):
    with pytest.raises(FormulaError, match=r"write|mean"):
        Parser(text, {"x"}, {})

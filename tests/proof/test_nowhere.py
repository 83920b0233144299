"""Images that are certainly no number are lost, not undecided: answers by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made
from test_proof import line, proved

from lmdsl.formulas.compiled import machine
from lmdsl.formulas.compiled.tape import Writer
from lmdsl.formulas.compiled.traced import Traced, trace
from lmdsl.formulas.compiled.undefined import as_number, never_a_number
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program
from lmdsl.model.grid.partition import Partition

NOWHERE = [  # no number left of 0.6, else in A
    "0.1*sqrt(x - 0.6)", "0.05 + 0*log(x - 0.6)", "0.1 + 0*asin(1.6 - x)", "0.1 + 0*acos(1.6 - x)",
    "0.1*(x - 0.6)**0.5", "min(0.1, 1 + sqrt(x - 0.6))", "where(x < 2, 0.1*sqrt(x - 0.6), x)",
    "0.1 + 0*abs(1/(1 + sqrt(x - 0.6)))",
]  # fmt: skip


@pytest.mark.parametrize("formula", NOWHERE)
@pytest.mark.parametrize("on_exit", ["forbid", "clip"])
def test_what_is_no_number_is_lost(formula, on_exit):
    """C are the cells from 0.5 on, of which a fifth is lost, but for a box at 0.6."""
    _, proof = proved(line(formula, on_exit=on_exit), target=0.799)
    assert proof.lost == pytest.approx(0.2, abs=5e-3)
    assert proof.arrives == pytest.approx(0.8, abs=2e-3)


@pytest.mark.parametrize("formula", ["where(x > 0.6, 0.1, 0.1*sqrt(x))", "0.1 + 0*sqrt(x)**0"])
def test_what_is_not_chosen_or_raised_to_0_is_a_number(formula):
    _, proof = proved(line(formula))
    assert proof.arrives == 1


@pytest.mark.parametrize("judged", ["path", "endpoint"])
def test_equations_whose_slope_is_no_number(judged):
    data = line("x", attractor={"cells": [[3]]})
    data["system"] = {"kind": "ode", "derivative": {"x": "0.9 + 0*sqrt(x - 0.6)"}, "step": 0.25,
                      "substeps": 2, "judged": judged}  # fmt: skip
    _, proof = proved(data, target=0.5999)
    assert proof.lost == pytest.approx(0.4, abs=0.02)


def test_a_rate_that_is_no_number_does_not_move_the_state():
    data = line("x", attractor={"cells": [[3]]}, cost_rate="1 + 0*sqrt(x - 0.01)")
    del data["stage_cost"]
    data["system"] = {"kind": "ode", "derivative": {"x": "0.9"}, "step": 0.25, "substeps": 1}
    _, proof = proved(data, target=0.9)
    assert proof.lost == 0


def flagged(formula, low, high):
    """Return whether a formula is said to be no number on a box."""
    program, writer = Program([parse(formula, {"x", "y"})]), Writer(2)
    given = {n: Traced(writer, writer.input(k), [], None) for k, n in enumerate("xy")}
    slots = []
    trace(program, given, slots)
    jet = as_number(writer, never_a_number(program, slots, 1, writer), 0)
    if jet is None:
        return False
    tape, (out,) = writer.finish([jet.value])
    rows = machine.registers(tape)
    for k in range(2):
        rows[k, 0], rows[k, 1] = low[k], high[k]
    machine.run(tape, rows)
    return bool(rows[out, 0, 0] > 0)


LEAVES = st.sampled_from(("x", "y", "0.5", "-1", "2"))
TERMS = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(("sqrt", "log", "asin", "acos", "abs", "sign", "exp")), inner)
        .map(lambda t: f"{t[0]}({t[1]})"),
        st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"(({t[0]}){t[1]}({t[2]}))"),
        st.tuples(inner, st.sampled_from(("0", "2", "0.5", "-1", "y"))).map(
            lambda t: f"({t[0]})**({t[1]})"),
        st.tuples(st.sampled_from(("min", "max", "atan2", "mod")), inner, inner)
        .map(lambda t: f"{t[0]}({t[1]}, {t[2]})"),
        st.tuples(inner, st.sampled_from(("<", "!=")), inner, inner, inner)
        .map(lambda t: f"where(({t[0]}){t[1]}({t[2]}), {t[3]}, {t[4]})"),
    ),
    max_leaves=8,
)  # fmt: skip


@settings(max_examples=400, deadline=None, derandomize=True)
@given(formula=TERMS, corner=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
       size=st.sampled_from((0.0, 1e-9, 0.01, 0.5)))  # fmt: skip
def test_nothing_that_is_a_number_somewhere_is_flagged(formula, corner, size):
    low, high = np.array(corner), np.array(corner) + size
    try:
        said = flagged(formula, low, high)
    except ValueError:  # a constant part is no number
        return
    if said:
        x, y = np.random.default_rng(0).uniform(low, high, (50, 2)).T
        (found,) = Program([parse(formula, {"x", "y"})])({"x": x, "y": y})
        assert np.isnan(found).all(), formula


def test_the_tape_is_there_only_where_it_is_needed():
    from lmdsl.model.successors.compiled.tapes import step

    assert not len(step(made(line("0.5*x**2 - x"))).nowhere.middle)
    problem = made(line("sqrt(x)"))
    assert len(step(problem).nowhere.middle) == 1
    assert Partition.of(problem).size == 4

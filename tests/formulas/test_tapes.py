"""Tapes of interval operations: what they enclose, against jets, computed values and exact ones."""

from __future__ import annotations

import numpy as np
import pytest
from hammering import hammer, jets_of

from lmdsl.formulas.compiled import machine
from lmdsl.formulas.compiled.tape import ONE, ZERO, Fixed, Writer
from lmdsl.formulas.compiled.traced import Traced, trace
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program


def taped(program, low, high):
    """Value, error and slopes of a formula on one box of many, rows of shape (2,)."""
    writer = Writer(2)
    given = {
        name: Traced(writer, writer.input(k), [ONE if i == k else None for i in range(2)], None)
        for k, name in enumerate("xy")
    }
    (jet,) = trace(program, given)
    slopes = [ZERO if p is None else p for p in jet.slope]
    error = ZERO if jet.error is None else jet.error
    tape, out = writer.finish([jet.value, error, *slopes])
    rows = machine.registers(tape)
    rng = np.random.default_rng(0)
    for k in range(2):  # the others are other boxes
        rows[k, 0], rows[k, 1] = rng.uniform(-3, 0, 64), rng.uniform(0, 3, 64)
        rows[k, :, 17] = low[k], high[k]
    machine.run(tape, rows)
    return [rows[k, :, 17].tolist() for k in out]


def down(x):
    return np.nextafter(np.nextafter(x, -np.inf), -np.inf)


def up(x):
    return -down(-x)


def by_tape(program, low, high):
    """N and the mean value form, intersected; and the error."""
    centre = low / 2 + high / 2
    value, (_, error), *slopes = taped(program, low, high)
    least, most = taped(program, centre, centre)[0]
    least, most = down(least - error), up(most + error)
    for (a, b), x, y in zip(slopes, down(low - centre), up(high - centre), strict=True):
        products = [a * x, a * y, b * x, b * y]
        least, most = down(least + down(min(products))), up(most + up(max(products)))
    if not most - least < np.inf:
        return [*value, error]
    return [max(least, value[0]), min(most, value[1]), error]


@pytest.mark.parametrize("plain", [False, True])
def test_what_is_computed_and_what_is_exact_lies_in_the_enclosure(plain):
    seen, narrow = hammer(5, 150, 30, plain, by_tape)
    assert seen > 1500
    assert narrow > 15


@pytest.mark.long
@pytest.mark.parametrize("plain", [False, True])
def test_the_same_for_many_formulas(plain):
    seen, narrow = hammer(6, 1500, 60, plain, by_tape)
    assert seen > 30_000
    assert narrow > 200


TEXTS = [
    "x + y", "x*y - 3*x", "sin(2*pi*x)*y + x", "x**2 + y**3 - 1/x", "exp(x)*log(y)", "x*x - x",
    "sqrt(x) + abs(y)", "min(x, y)", "max(x, y)*tan(x)", "where(x < y, x, y*2)", "atan2(y, x)",
    "mod(x, 0.7)", "mod(x, y)", "floor(x) + ceil(y)", "sign(x)*y", "x**y", "x**1.5", "x**-2",
    "tanh(x)*sinh(y) - cosh(x)", "atan(x)/(1 + x**2)", "asin(x/5) + acos(y/5)", "cos(x)*cos(x)",
    "where(x > 1 and y < 2 or not x > 0.2, x*y, x - y)", "where(x != y, 1/y, x)", "2", "x**0",
]  # fmt: skip


@pytest.mark.parametrize("text", TEXTS)
def test_as_wide_as_jets_but_for_rounding(text):
    """Values, errors and slopes; a row that is the line where a jet is not is no claim."""
    rng = np.random.default_rng(1)
    program = Program([parse(text, {"x", "y"})])
    for _ in range(60):
        low = rng.uniform(-2, 3, 2)
        high = low + rng.choice([0, 1e-9, 1e-3, 0.5, 2.0], 2)
        value, (_, error), *slopes = taped(program, low, high)
        with np.errstate(all="ignore"):
            jet = program.enclose(jets_of(low, high))[0]
        ends = [(jet.value, value), *((type(jet.value)(*(np.broadcast_to(e, (2, 1))[k]
                for e in jet.slope)), slopes[k]) for k in range(2))]  # fmt: skip
        for theirs, ours in ends:
            least, most = (float(np.ravel(end)[0]) for end in theirs)
            if np.isfinite([least, most, *ours]).all():
                scale = 1e-13 * (1 + abs(least) + abs(most))
                assert ours == pytest.approx([least, most], abs=scale), (low, high)
            else:
                assert ours == [-np.inf, np.inf] or not np.isfinite([least, most]).all()
        bound = float(np.ravel(jet.error)[0])
        if np.isfinite(bound):
            assert error <= 20 * bound + 1e-15 * (1 + max(np.abs(value)))


def test_numbers_are_folded_and_operations_written_once():
    writer = Writer(1)
    x = writer.input(0)
    assert writer.add(Fixed(1.0, 1.0), Fixed(2.0, 2.0)).low == pytest.approx(3)
    assert writer.multiply(ONE, x) is x
    assert writer.add(x, ONE) is writer.add(x, ONE)
    assert len(writer.written) == 1


def test_registers_are_used_again_and_no_operand_is_overwritten():
    program = Program([parse("+".join(f"sin({k}*x)*y" for k in range(1, 40)), {"x", "y"})])
    writer = Writer(2)
    given = {n: Traced(writer, writer.input(k), [], None) for k, n in enumerate("xy")}
    tape, _ = writer.finish([trace(program, given)[0].value])
    varying = np.isnan(tape.constants[:, 0])
    assert varying.sum() < 10
    assert all(target not in operands for _, target, *operands in tape.code.tolist())


def test_rows_that_are_kept_for_the_next_run_change_places():
    """Both inputs are exchanged, and one of them is an output as it was."""
    writer = Writer(2)
    x, y = writer.input(0), writer.input(1)
    tape, out = writer.finish([x, writer.add(x, y)], {0: y, 1: x})
    rows = machine.registers(tape)
    rows[0], rows[1] = 1.0, 5.0
    machine.run(tape, rows)
    assert (rows[0] == 5).all()
    assert (rows[1] == 1).all()
    assert (rows[out[0]] == 1).all()
    assert rows[out[1]] == pytest.approx(6)

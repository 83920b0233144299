"""The machine that runs tapes of interval operations on blocks of boxes.

A tape is a list of instructions on registers; a register is a row of a block (arithmetic.py).
Nothing of a formula becomes program text: a tape holds numbers only, and is as long as the formula.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats
from lmdsl.formulas.compiled import arithmetic, choices, errors, functions
from lmdsl.machine.kernels import kernel

BLOCK = 64  # boxes at a time: registers of all of them lie in a fast cache

(ADD, SUBTRACT, NEGATIVE, MULTIPLY, SCALE, SQUARE, DIVIDE, ABSOLUTE, SMALLER, COPY,
 ROUNDED, MOVED, DIVIDED, LARGER, WIDTH, CHOOSE_ERROR,
 CHOOSE, CHOOSE_ONE, FLAT, FLOORS, REMAINDER, SPREAD, POWER, TURN) = range(24)  # fmt: skip
FUNCTION, CONDITION = 32, 64  # first of the elementary functions, and of the conditions


class IntervalTape(NamedTuple):
    """What a machine runs.

    Attributes
    ----------
    code
        Shape (instructions, 6): operation, target, and up to four operands, all registers.
    number
        Shape (instructions,): a number that some operations need.
    constants
        Shape (registers, 2): the ends of what does not vary, NaN for registers that do.
    """

    code: NDArray[np.int64]
    number: Floats
    constants: Floats


def registers(tape: IntervalTape) -> Floats:
    """Return registers for a tape, its constants in place, shape (registers, 2, BLOCK)."""
    return np.repeat(np.nan_to_num(tape.constants, posinf=np.inf, neginf=-np.inf)[:, :, None],
                     BLOCK, axis=2)  # fmt: skip


@kernel
def run(tape, rows):  # type: ignore[no-untyped-def]
    """Run a tape on registers."""
    for j in range(len(tape.code)):
        op, x = tape.code[j, 0], tape.number[j]
        t, a, b = rows[tape.code[j, 1]], rows[tape.code[j, 2]], rows[tape.code[j, 3]]
        c, d = rows[tape.code[j, 4]], rows[tape.code[j, 5]]
        if op <= COPY:
            _arithmetic(op, t, a, b, x)
        elif op <= CHOOSE_ERROR:
            _error(op, t, a, b, c, d, x)
        elif op <= TURN:
            _choice(op, t, a, b, c, d, x)
        elif op < CONDITION:
            functions.apply(op - FUNCTION, t, a)
        else:
            choices.decide(op - CONDITION, t, a, b)


@kernel
def _arithmetic(op, t, a, b, x):  # type: ignore[no-untyped-def]
    if op == ADD:
        arithmetic.add(t, a, b)
    elif op == SUBTRACT:
        arithmetic.subtract(t, a, b)
    elif op == MULTIPLY:
        arithmetic.multiply(t, a, b)
    elif op == SCALE:
        arithmetic.scale(t, a, x)
    elif op == SQUARE:
        arithmetic.square(t, a)
    elif op == NEGATIVE:
        arithmetic.negative(t, a)
    elif op == DIVIDE:
        arithmetic.divide(t, a, b)
    elif op == ABSOLUTE:
        arithmetic.absolute(t, a)
    elif op == SMALLER:
        arithmetic.smaller(t, a, b)
    else:
        arithmetic.copy(t, a)


@kernel
def _error(op, t, a, b, c, d, x):  # type: ignore[no-untyped-def]
    if op == ROUNDED:
        errors.rounded(t, a, b, c, x)
    elif op == MOVED:
        errors.moved(t, a, b)
    elif op == DIVIDED:
        errors.divided(t, a, b, c)
    elif op == LARGER:
        errors.larger(t, a, b)
    elif op == WIDTH:
        errors.width(t, a)
    else:
        errors.choose(t, a, b, c, d)


@kernel
def _choice(op, t, a, b, c, d, x):  # type: ignore[no-untyped-def]
    if op == CHOOSE:
        choices.choose(t, a, b, c)
    elif op == CHOOSE_ONE:
        choices.choose_one(t, a, b, c)
    elif op == FLAT:
        choices.flat(t, a)
    elif op == FLOORS:
        choices.floors(t, a, b)
    elif op == REMAINDER:
        choices.remainder(t, a, b, c, d)
    elif op == SPREAD:
        functions.spread(t, a)
    elif op == POWER:
        functions.power(t, a, x)
    else:
        functions.turn(t, a, b)

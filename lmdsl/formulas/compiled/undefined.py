"""Where formulas are certainly no number on a box: one more output of a tape.

Only functions with a domain are looked at: roots and logarithms of what is negative, and so on.
What is made of no number is none, but for what a condition leaves out, and for 0 and other powers
of what may be one.
"""

from collections.abc import Sequence
from typing import Any

from lmdsl.formulas.compiled import choices, machine
from lmdsl.formulas.compiled.tape import ONE, ZERO, Fixed, Slot, Value, Writer
from lmdsl.formulas.compiled.traced import Traced
from lmdsl.formulas.operations import CONNECTIVES
from lmdsl.formulas.program import Program
from lmdsl.formulas.truths import COMPARED

Flag = Slot | None  # a condition that holds where a number is certainly none; None: it never does


def never_a_number(program: Program, slots: Sequence[Any], outputs: int, to: Writer) -> list[Flag]:
    """Return of some outputs of a program, traced into slots, where they are no number."""
    flags: dict[int, Flag] = {}
    for operation, operands, target, *_ in program.instructions:
        known = [flags.get(k) for k in operands]
        traced = [slots[k] for k in operands]
        if operation in CONNECTIVES or operation in COMPARED:
            continue
        if operation == "where":
            flags[target] = _chosen(to, traced[0], known[1], known[2])
        elif operation == "**":
            flags[target] = _raised(to, traced[0].value, traced[1].value, known[0])
        else:
            flags[target] = _either(to, [*known, *_outside(to, operation, traced)])
    return [flags.get(slot) for slot in program.outputs[:outputs]]


def as_number(to: Writer, flags: Sequence[Flag], directions: int) -> Traced | None:
    """Return 1 where some flag holds and 0 where none does; None: none ever does."""
    flag = _either(to, flags)
    if flag is None:
        return None
    jump = to.emit(machine.CHOOSE_ONE, flag, ZERO, ZERO)
    return Traced(to, to.emit(machine.CHOOSE, flag, ONE, ZERO), [jump] * directions, None)


def _condition(to: Writer, name: str, a: Value, b: Value) -> Slot:
    return to.emit(machine.CONDITION + choices.NAMES.index(name), a, b)


def _either(to: Writer, flags: Sequence[Flag]) -> Flag:
    found: Flag = None
    for flag in flags:
        if flag is not None:
            found = flag if found is None else _condition(to, "or", found, flag)
    return found


def _outside(to: Writer, operation: str, operands: Sequence[Traced]) -> list[Flag]:
    """Return where operands certainly lie outside the domain of a function."""
    a = operands[0].value
    if operation in ("sqrt", "log"):
        return [_condition(to, "<", a, ZERO)]
    if operation in ("asin", "acos"):
        return [_condition(to, "<", ONE, a), _condition(to, "<", a, Fixed(-1.0, -1.0))]
    return []


def _raised(to: Writer, a: Value, p: Value, known: Flag) -> Flag:
    """Return where a ** p is no number: nothing is said unless p is a number other than 0."""
    if not (isinstance(p, Fixed) and p.low == p.high) or p.low == 0.0:
        return None
    own = None if p.low.is_integer() else _condition(to, "<", a, ZERO)
    return _either(to, [known, own])


def _chosen(to: Writer, condition: Any, a: Flag, b: Flag) -> Flag:
    """Return where what a condition chooses is no number: surely so if both may be chosen."""
    if a is None and b is None:
        return None
    c = condition.value if isinstance(condition, Traced) else condition
    return to.emit(machine.CHOOSE, c, a or ZERO, b or ZERO)

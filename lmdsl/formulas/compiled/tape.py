"""Writing tapes: each operation once, numbers folded, registers used again when they are free."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lmdsl.formulas import intervals as iv
from lmdsl.formulas.compiled import machine
from lmdsl.formulas.compiled.machine import IntervalTape
from lmdsl.formulas.intervals import Interval


class Slot(NamedTuple):
    """What a register will hold."""

    key: int


class Fixed(NamedTuple):
    """An interval that does not vary."""

    low: float
    high: float


Value = Slot | Fixed

ZERO, ONE = Fixed(0.0, 0.0), Fixed(1.0, 1.0)


class _Written(NamedTuple):
    operation: int
    operands: tuple[Value, ...]
    number: float


class Writer:
    """Takes operations down.

    Parameters
    ----------
    inputs
        Number of rows that are given; they are the first registers.
    units
        Whether products with 1 and -1 are exact; else they are rounded as others are.
    """

    def __init__(self, inputs: int, units: bool = True) -> None:
        self.inputs, self.units = inputs, units
        self._written: list[_Written] = []
        self._known: dict[_Written, Slot] = {}

    def input(self, k: int) -> Slot:
        """Return the k-th of the rows that are given."""
        return Slot(k)

    def emit(self, operation: int, *operands: Value, number: float = 0.0) -> Slot:
        """Return the row of an operation."""
        written = _Written(operation, operands, number)
        if written not in self._known:
            self._known[written] = Slot(self.inputs + len(self._written))
            self._written.append(written)
        return self._known[written]

    def add(self, a: Value, b: Value) -> Value:
        """Return a + b."""
        if isinstance(a, Fixed) and isinstance(b, Fixed):
            return _fixed(iv.add(_interval(a), _interval(b)))
        return self.emit(machine.ADD, a, b)

    def subtract(self, a: Value, b: Value) -> Value:
        """Return a - b."""
        if isinstance(a, Fixed) and isinstance(b, Fixed):
            return _fixed(iv.subtract(_interval(a), _interval(b)))
        return self.emit(machine.SUBTRACT, a, b)

    def negative(self, a: Value) -> Value:
        """Return -a."""
        return Fixed(-a.high, -a.low) if isinstance(a, Fixed) else self.emit(machine.NEGATIVE, a)

    def multiply(self, a: Value, b: Value) -> Value:
        """Return a b; products with 0 are exact."""
        if isinstance(b, Fixed):
            a, b = b, a
        if not isinstance(a, Fixed):
            return self.emit(machine.SQUARE, a) if a == b else self.emit(machine.MULTIPLY, a, b)
        if isinstance(b, Fixed):
            return _fixed(iv.multiply(_interval(a), _interval(b)))
        if self.units and a == ONE:
            return b
        if self.units and a == Fixed(-1.0, -1.0):
            return self.negative(b)
        if a.low == a.high:
            return self.emit(machine.SCALE, b, number=a.low)
        return self.emit(machine.MULTIPLY, a, b)

    def square(self, a: Value) -> Value:
        """Return a a, which is never negative."""
        if isinstance(a, Fixed):
            return _fixed(iv.square(_interval(a)))
        return self.emit(machine.SQUARE, a)

    def divide(self, a: Value, b: Value) -> Value:
        """Return a / b."""
        return self.emit(machine.DIVIDE, a, b)

    def finish(
        self, outputs: Sequence[Value], into: Mapping[int, Value] = {}
    ) -> tuple[IntervalTape, list[int]]:
        """Return the tape, and the registers of what is asked for.

        ``into`` names input registers that hold something else at the end, as the next run needs
        it. Where it is given, outputs are read before that, and so are copied too.
        """
        return _Allocation(self, outputs, into).done()

    @property
    def written(self) -> list[_Written]:
        """The operations in order."""
        return self._written


class _Allocation:
    """Registers for rows: given ones first, then constants, then what is worked out."""

    def __init__(self, writer: Writer, outputs: Sequence[Value], into: Mapping[int, Value]) -> None:
        self.writer, self.outputs, self.into = writer, outputs, into
        self.constants: dict[Fixed, int] = {}
        self.place: dict[int, int] = {k: k for k in range(writer.inputs)}
        self.free: list[int] = []
        self.code: list[list[int]] = []
        self.number: list[float] = []
        needed = self._needed()
        for value in (
            ZERO,
            *(x for w in needed.values() for x in w.operands),
            *outputs,
            *into.values(),
        ):
            if isinstance(value, Fixed):
                self.constants.setdefault(value, writer.inputs + len(self.constants))
        self.count = writer.inputs + len(self.constants)
        self.last = self._last_uses(needed)
        for key, written in needed.items():
            self._allocate(key, written)

    def _needed(self) -> dict[int, _Written]:
        writer = self.writer
        needed = {x.key for x in (*self.outputs, *self.into.values()) if isinstance(x, Slot)}
        kept: dict[int, _Written] = {}
        for k in range(len(writer.written) - 1, -1, -1):
            key = writer.inputs + k
            if key in needed:
                kept[key] = writer.written[k]
                needed.update(x.key for x in writer.written[k].operands if isinstance(x, Slot))
        return dict(reversed(kept.items()))

    def _last_uses(self, needed: Mapping[int, _Written]) -> dict[int, int]:
        last: dict[int, int] = {}
        for key, written in needed.items():
            last.update({x.key: key for x in written.operands if isinstance(x, Slot)})
        for x in (*self.outputs, *self.into.values()):
            if isinstance(x, Slot):
                last[x.key] = -1  # to the end
        return last

    def _register(self, x: Value) -> int:
        return self.constants[x] if isinstance(x, Fixed) else self.place[x.key]

    def _allocate(self, key: int, written: _Written) -> None:
        """Choose a register that is no operand's: loops then know that rows do not overlap."""
        if self.free:
            target = self.free.pop()
        else:
            target, self.count = self.count, self.count + 1
        self.place[key] = target
        self._note(
            written.operation, target, [self._register(x) for x in written.operands], written.number
        )
        for other in {x.key for x in written.operands if isinstance(x, Slot)}:
            if self.last[other] == key and other >= self.writer.inputs:
                self.free.append(self.place[other])

    def _note(
        self, operation: int, target: int, operands: Sequence[int], number: float = 0.0
    ) -> None:
        zero = self.constants[ZERO]
        self.code.append([operation, target, *operands, *[zero] * (4 - len(operands))])
        self.number.append(number)

    def done(self) -> tuple[IntervalTape, list[int]]:
        """Return the tape, copies at its end, and the registers of the outputs."""
        places = []
        for x in self.outputs:
            if self.into and isinstance(x, Slot) and x.key in self.into:
                self._note(machine.COPY, self.count, [self._register(x)])
                places.append(self.count)
                self.count += 1
            else:
                places.append(self._register(x))
        moves = {k: self._register(x) for k, x in self.into.items() if self._register(x) != k}
        spare = {}
        for k in {*moves} & {*moves.values()}:  # read before it is written
            self._note(machine.COPY, self.count, [k])
            spare[k], self.count = self.count, self.count + 1
        for k, source in moves.items():
            self._note(machine.COPY, k, [spare.get(source, source)])
        constants = np.full((self.count, 2), np.nan)
        for value, k in self.constants.items():
            constants[k] = value
        code = np.array(self.code, dtype=np.int64).reshape(-1, 6)
        return IntervalTape(code, np.array(self.number), constants), places


def _interval(a: Fixed) -> Interval:
    return Interval(np.float64(a.low), np.float64(a.high))


def _fixed(a: Interval) -> Fixed:
    return Fixed(float(a.low), float(a.high))

"""Evaluating formulas: several compiled together into one flat list of array operations."""

import copy
from collections.abc import Mapping, Sequence
from operator import is_
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput
from lmdsl.formulas.enclosures import Jet, apply, truth
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.language import Formula
from lmdsl.formulas.operations import OPERATIONS, PLAIN
from lmdsl.formulas.parser import Subformula, fold
from lmdsl.formulas.truths import Truth


class Instruction(NamedTuple):
    """An operation on slots; ``released`` are those that nothing reads any more."""

    operation: str
    operands: tuple[int, ...]
    target: int
    released: tuple[int, ...] = ()
    reusable: tuple[int, ...] = ()  # those of them that may hold the result


class Program:
    """Several formulas compiled together, each distinct subformula evaluated once.

    Parameters
    ----------
    formulas
        The formulas, in the order of the results.
    constants
        Values of the names that do not vary (parameters). They are folded with the
        arithmetic of arrays; what is not finite is kept, for the caller to judge.

    Attributes
    ----------
    formulas, constants
        The formulas, and the values of names in them.
    names
        The names that a call must give values for.
    variables, template
        The slot of each of them; of every slot its value where it is constant, else None.
    instructions, outputs
        What a call does, and the slots of its results.
    operations
        The operations of one call in order, for inspection.
    live
        Largest number of arrays at a time, inputs apart.
    effort, work
        Their number, at least 1; the same with functions such as the sine counted many times, for
        the time they take.
    """

    def __init__(self, formulas: Sequence[Formula], constants: Mapping[str, float] = {}) -> None:
        self.formulas: tuple[Formula, ...] = tuple(formulas)
        self.constants = dict(constants)
        self._slots: dict[tuple[object, ...], int] = {}
        self.template: list[float | None] = []  # by slot: a constant, None for what varies
        self.outputs: list[int] = []
        instructions: list[Instruction] = []
        placed: list[int] = []
        longest: tuple[Subformula, ...] = ()
        for formula in formulas:
            parts = formula.subformulas
            known = min(len(parts), len(longest))  # formulas of one recorder begin alike
            if not all(map(is_, parts[:known], longest)):
                placed, longest, known = [], (), 0
            for part in parts[known:]:
                key, value = self._identify(part, [placed[k] for k in part.operands], constants)
                slot = self._slots.setdefault(key, len(self.template))
                if slot == len(self.template):
                    self.template.append(value)
                    if value is None and part.operands:
                        instructions.append(Instruction(part.operation, key[1], slot))
                placed.append(slot)
            longest = max(longest, parts, key=len)
            self.outputs.append(placed[len(parts) - 1])
        self.variables = {str(k[1]): s for k, s in self._slots.items() if k[0] == "name"}
        self.instructions = self._with_lifetimes(_needed(instructions, self.outputs))
        self.names = frozenset(self.variables)
        self.operations = tuple(instruction.operation for instruction in instructions)
        self.effort, self.work = _effort(self.operations)

    def _identify(
        self, part: Subformula, operands: Sequence[int], constants: Mapping[str, float]
    ) -> tuple[tuple[str, Any], float | None]:
        """Return a key, the same for subformulas with equal bits, and the value if constant."""
        values = [value for k in operands if (value := self.template[k]) is not None]
        if part.operation == "constant":
            value = part.value
        elif part.name in constants:
            value = float(constants[part.name])
        elif operands and len(values) == len(operands):
            value = fold(part.operation, values)
        else:
            return (part.operation, part.name or tuple(operands)), None
        return ("constant", np.float64(value).tobytes()), value

    def _with_lifetimes(self, instructions: Sequence[Instruction]) -> list[Instruction]:
        live = set(self.outputs) | {k for k, v in enumerate(self.template) if v is not None}
        inputs = set(self.variables.values())
        marked: list[Instruction] = []
        for instruction in reversed(instructions):
            released = tuple(dict.fromkeys(k for k in instruction.operands if k not in live))
            live.update(instruction.operands)
            in_place = instruction.operation in PLAIN
            reusable = tuple(k for k in released if in_place and k not in inputs)
            marked.append(instruction._replace(released=released, reusable=reusable))
        alive = self.live = 0
        for instruction in reversed(marked):
            alive += 1
            self.live = max(self.live, alive + 1)  # an operation may need one more for itself
            alive -= sum(k not in inputs for k in instruction.released)
        return marked[::-1]

    def part(self, outputs: Sequence[int]) -> "Program":
        """Return the program that computes some of the slots, and nothing that they do not need."""
        part = copy.copy(self)
        part.outputs = list(outputs)
        needed = _needed(self.instructions, outputs)
        read = {*outputs, *(k for instruction in needed for k in instruction.operands)}
        part.variables = {name: k for name, k in self.variables.items() if k in read}
        part.instructions = part._with_lifetimes(needed)
        part.names, part.formulas = frozenset(part.variables), ()
        part.operations = tuple(instruction.operation for instruction in part.instructions)
        part.effort, part.work = _effort(part.operations)
        return part

    def __call__(
        self, values: Mapping[str, NDArray[Any] | float], guard: Guard | None = None
    ) -> tuple[Floats, ...]:
        """Return a new array for each formula, in the broadcast shape of the names it uses.

        ``values`` has an array or number for each of `names`, in shapes that broadcast together;
        they are read as float64 and never changed, other keys ignored. ``guard`` is called before
        every operation.
        """
        if not self.names <= values.keys():
            missing = ", ".join(sorted(self.names.difference(values)))
            raise BadInput(f"no value is given for {missing}; give one for every name")
        slots: list[Any] = list(self.template)
        for name, slot in self.variables.items():
            slots[slot] = np.asarray(values[name], dtype=np.float64)
        with np.errstate(all="ignore"):
            for operation, places, target, released, reusable in self.instructions:
                if guard is not None:
                    guard()
                operands = [slots[k] for k in places]
                buffer = _buffer(operands, [slots[k] for k in reusable]) if reusable else {}
                slots[target] = OPERATIONS[operation](*operands, **buffer)
                for k in released:
                    slots[k] = None
        aliases = set(self.variables.values())
        results: list[Floats] = []
        for slot in self.outputs:  # no result shares memory with an input or another result
            result = np.asarray(slots[slot], dtype=np.float64)
            results.append(result.copy() if slot in aliases else result)
            aliases.add(slot)
        return tuple(results)

    def enclose(self, values: Mapping[str, Jet], guard: Guard | None = None) -> tuple[Jet, ...]:
        """Enclose all formulas and their derivatives on boxes (see enclosures.py).

        ``values`` has a jet for each of `names`, all with the same number of directions.
        """
        directions = max((len(jet.slope.low) for jet in values.values()), default=0)
        return tuple(self._enclosed(values, directions, guard))

    def decide(
        self, values: Mapping[str, Interval], guard: Guard | None = None
    ) -> tuple[Truth, ...]:
        """Return of all formulas, which are conditions, what is known of them on boxes.

        Parameters
        ----------
        values
            An interval for each of `names`.
        guard
            Called before every operation; it may raise.
        """
        axes = max((np.ndim(values[name].low) for name in self.names), default=1)
        none = Interval.point(np.zeros((0, *(1,) * axes)))
        jets = {name: Jet(values[name], none, 0.0) for name in self.names}
        return tuple(truth(found) for found in self._enclosed(jets, 0, guard))

    def _enclosed(
        self, values: Mapping[str, Jet], directions: int, guard: Guard | None
    ) -> list[Any]:
        axes = max((np.ndim(jet.slope.low) - 1 for jet in values.values()), default=1)
        slots: list[Any] = [
            None if value is None else Jet.constant(value, directions, axes)
            for value in self.template
        ]
        for name, slot in self.variables.items():
            slots[slot] = values[name]
        with np.errstate(all="ignore"):
            for operation, operands, target, *_ in self.instructions:
                if guard is not None:
                    guard()
                slots[target] = apply(operation, [slots[k] for k in operands])
        return [slots[slot] for slot in self.outputs]


FUNCTION = 40  # additions that take as long as a sine or a cosine, the slowest functions there are


def _effort(operations: Sequence[str]) -> tuple[int, int]:
    """Return the number of operations, and the additions that take as long."""
    plain = sum(operation in PLAIN for operation in operations)
    return max(len(operations), 1), max(plain + FUNCTION * (len(operations) - plain), 1)


def _needed(instructions: Sequence[Instruction], outputs: Sequence[int]) -> list[Instruction]:
    """Return the instructions whose results are needed: nothing would ever release the others."""
    needed, kept = set(outputs), []
    for instruction in reversed(instructions):
        if instruction.target in needed:
            needed.update(instruction.operands)
            kept.append(instruction)
    return kept[::-1]


def _buffer(operands: list[Any], reusable: list[Any]) -> dict[str, Any]:
    """Return ``out=`` with a reusable array that already has the shape of the result."""
    for array in reusable:
        fits = isinstance(array, np.ndarray) and np.broadcast(*operands).shape == array.shape
        if fits:
            return {"out": array}
    return {}

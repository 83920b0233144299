"""Evaluating formulas: several compiled together into one flat list of array operations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput
from lmdsl.formulas import IN_PLACE, OPERATIONS, Formula, Step, fold
from lmdsl.jets import Jet, apply


class _Instruction(NamedTuple):
    operation: str
    operands: tuple[int, ...]
    target: int
    released: tuple[int, ...] = ()  # slots that nothing reads any more
    reusable: tuple[int, ...] = ()  # those of them that may hold the result


class Program:
    """Several formulas compiled together, each distinct step evaluated once.

    Parameters
    ----------
    formulas
        The formulas, in the order of the results.
    constants
        Values of the names that do not vary (parameters). They are folded with the
        arithmetic of arrays; what is not finite is kept, for the caller to judge.

    Attributes
    ----------
    names
        The names that a call must give values for.
    operations
        The operations of one call in order, for inspection.
    effort
        Their number, at least 1.
    """

    def __init__(self, formulas: Sequence[Formula], constants: Mapping[str, float] = {}) -> None:
        self._slots: dict[tuple[object, ...], int] = {}
        self._template: list[float | None] = []  # by slot: a constant, None for what varies
        self._outputs: list[int] = []
        instructions: list[_Instruction] = []
        for formula in formulas:
            placed: list[int] = []
            for step in formula.steps:
                key, value = self._identify(step, [placed[k] for k in step.operands], constants)
                slot = self._slots.setdefault(key, len(self._template))
                if slot == len(self._template):
                    self._template.append(value)
                    if value is None and step.operands:
                        instructions.append(_Instruction(step.operation, key[1], slot))
                placed.append(slot)
            self._outputs.append(placed[-1])
        self._variables = {str(k[1]): s for k, s in self._slots.items() if k[0] == "name"}
        self._instructions = self._with_lifetimes(instructions)
        self.names = frozenset(self._variables)
        self.operations = tuple(step.operation for step in instructions)
        self.effort = max(len(instructions), 1)

    def _identify(
        self, step: Step, operands: Sequence[int], constants: Mapping[str, float]
    ) -> tuple[tuple[str, Any], float | None]:
        """Return a key, the same for steps with equal bits, and the value if constant."""
        values = [value for k in operands if (value := self._template[k]) is not None]
        if step.operation == "constant":
            value = step.value
        elif step.name in constants:
            value = float(constants[step.name])
        elif operands and len(values) == len(operands):
            value = fold(step.operation, values)
        else:
            return (step.operation, step.name or tuple(operands)), None
        return ("constant", np.float64(value).tobytes()), value

    def _with_lifetimes(self, instructions: Sequence[_Instruction]) -> list[_Instruction]:
        live = set(self._outputs) | {k for k, v in enumerate(self._template) if v is not None}
        inputs = set(self._variables.values())
        marked: list[_Instruction] = []
        for step in reversed(instructions):
            released = tuple(dict.fromkeys(k for k in step.operands if k not in live))
            live.update(step.operands)
            in_place = step.operation in IN_PLACE
            reusable = tuple(k for k in released if in_place and k not in inputs)
            marked.append(step._replace(released=released, reusable=reusable))
        return marked[::-1]

    def __call__(
        self, values: Mapping[str, NDArray[Any] | float]
    ) -> tuple[NDArray[np.float64], ...]:
        """Evaluate all formulas.

        Parameters
        ----------
        values
            An array or number for each of `names`, in shapes that broadcast together.
            They are read as float64 and never changed; other keys are ignored.

        Returns
        -------
        tuple of ndarray
            One new array per formula, in the broadcast shape of the names it uses.
        """
        if not self.names <= values.keys():
            missing = ", ".join(sorted(self.names.difference(values)))
            raise BadInput(f"no value is given for {missing}; give one for every name")
        slots: list[Any] = list(self._template)
        for name, slot in self._variables.items():
            slots[slot] = np.asarray(values[name], dtype=np.float64)
        with np.errstate(all="ignore"):
            for operation, places, target, released, reusable in self._instructions:
                operands = [slots[k] for k in places]
                room = _room(operands, [slots[k] for k in reusable]) if reusable else {}
                slots[target] = OPERATIONS[operation](*operands, **room)
                for k in released:
                    slots[k] = None
        aliases = set(self._variables.values())
        results: list[NDArray[np.float64]] = []
        for slot in self._outputs:  # no result shares memory with an input or another result
            result = np.asarray(slots[slot], dtype=np.float64)
            results.append(result.copy() if slot in aliases else result)
            aliases.add(slot)
        return tuple(results)

    def enclose(self, values: Mapping[str, Jet]) -> tuple[Jet, ...]:
        """Enclose all formulas and their derivatives on boxes (see jets.py).

        Parameters
        ----------
        values
            A jet for each of `names`, all with the same number of directions.
        """
        directions = max((len(jet.slope.low) for jet in values.values()), default=0)
        slots: list[Any] = [
            None if value is None else Jet.constant(value, directions) for value in self._template
        ]
        for name, slot in self._variables.items():
            slots[slot] = values[name]
        with np.errstate(all="ignore"):
            for step in self._instructions:
                slots[step.target] = apply(step.operation, [slots[k] for k in step.operands])
        return tuple(slots[slot] for slot in self._outputs)


def _room(operands: list[Any], reusable: list[Any]) -> dict[str, Any]:
    """Return ``out=`` with a reusable array that already has the shape of the result."""
    for array in reusable:
        fits = isinstance(array, np.ndarray) and np.broadcast(*operands).shape == array.shape
        if fits:
            return {"out": array}
    return {}

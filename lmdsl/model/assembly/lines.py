"""Arithmetic that depends on the control, line by line in the first-level cache.

On blocks of samples, arrays that vary with the control and the state are many times larger than
those that vary with one of them. Where they come from plain arithmetic alone, such arrays are never
made: NumPy evaluates the small ones, and a compiled loop does the rest for a few hundred samples at
a time, locates the images and sums the costs. Plain arithmetic is correctly rounded, so the bits
are those of NumPy. Formulas with a sine of the control, say, go the other way (sampler.py).
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.formulas.operations import PLAIN
from lmdsl.formulas.program import Instruction, Program
from lmdsl.model.assembly.tape import Inputs, Located, Tape, run
from lmdsl.model.grid.axis import AxisCells

LINE = 512  # number of samples at a time: a dozen lines of them fit into the first-level cache

# Number of instructions below which NumPy is as fast, and above which lines leave the cache.
LEAST, MOST = 8, 1_000


@dataclass(frozen=True, eq=False)
class Lines:
    """Formulas split into what NumPy evaluates and what is done line by line."""

    # the program of the small arrays: those outputs that are small, then the inputs of the rest
    early: Program
    varying: tuple[int, ...]  # for each output its row among the lines, -1 where it is small
    tape: Tape  # what is done line by line

    @classmethod
    def of(cls, program: Program, controls: Collection[str]) -> Self | None:
        """Split a program; None where it gains nothing, or large arrays need more than arithmetic.

        ``controls`` are the names of the values that vary along one axis, all others along the
        rest.
        """
        varying = _varying(program, controls)
        if varying is None or not LEAST <= len(varying) <= MOST:
            return None
        made = {step.target for step in varying}
        read = dict.fromkeys(k for step in varying for k in step.operands if k not in made)
        inputs = [k for k in read if program.template[k] is None]
        constants = [k for k in read if program.template[k] is not None]
        row = {k: r for r, k in enumerate([*inputs, *constants])}
        tape, rows = _placed(varying, row, {k for k in program.outputs if k in made})
        return cls(
            program.part([*(k for k in program.outputs if k not in made), *inputs]),
            tuple(row[k] if k in made else -1 for k in program.outputs),
            Tape(
                np.array(tape, dtype=np.int64),
                np.array([program.template[k] for k in constants], dtype=np.float64),
                len(inputs),
                rows,
            ),
        )

    def __call__(
        self,
        values: Mapping[str, Any],
        shape: tuple[int, int, int, int],
        axes: Sequence[AxisCells],
        clip: bool,
        weights: Floats | None,
    ) -> tuple[Floats | None, Floats | None]:
        """Locate the images of a block and average its costs.

        Parameters
        ----------
        values
            Named arrays, as for the program.
        shape
            What they broadcast to: (first, points, nodes, last).
        axes, clip
            One axis for each of the first outputs, and whether images are moved into the box.
        weights
            Of the nodes, where the last output is a cost.

        Returns
        -------
        index : shape (first, samples, last)
            Cells as doubles, NaN outside; None where all images are small.
        mean : shape (first, last)
            As :func:`lmdsl.model.assembly.merging.mean_cost` has it; None where the cost is small.
        """
        arrays = list(self.early(values))
        small = [row < 0 for row in self.varying]
        found, inputs = iter(arrays[: sum(small)]), arrays[sum(small) :]
        base: Any = None  # images on axes that do not depend on the control: located once for all
        for axis, early in zip(axes, small, strict=False):
            if early:
                part = axis.add_index(next(found), clip, None)
                base = part if base is None else base + part
        axes = list(axes) if not all(small[: len(axes)]) else []
        large = [(axis, row) for axis, row in zip(axes, self.varying, strict=False) if row >= 0]
        located = Located(
            np.array([row for _, row in large], dtype=np.int64),
            np.array([axis for axis, _ in large], dtype=np.float64).reshape(-1, 6),
            clip,
        )
        first, points, nodes, last = shape
        index = np.empty((first if large else 0, points * nodes, last))
        cost_at = self.varying[-1] if weights is not None else -1
        mean = np.zeros((first if cost_at >= 0 else 0, last))
        packed = Inputs.of(inputs if base is None else [*inputs, base])
        weights = np.ones(nodes) if weights is None else weights
        run(LINE, self.tape, packed, shape, located, index, cost_at, weights, mean)
        return (index if large else None), (mean if cost_at >= 0 else None)


def _varying(program: Program, controls: Collection[str]) -> list[Instruction] | None:
    """Return the instructions whose results vary with a control and something else, in order.

    None where one of them is not plain arithmetic. A square becomes a product.
    """
    varies = {k: (name in controls, name not in controls) for name, k in program.variables.items()}
    varying = []
    for step in program.instructions:
        kinds = [varies.get(k, (False, False)) for k in step.operands]
        varies[step.target] = any(c for c, _ in kinds), any(o for _, o in kinds)
        if not all(varies[step.target]):
            continue
        operation, operands = step.operation, step.operands
        if operation == "**" and program.template[operands[1]] == 2.0:
            operation, operands = "*", (operands[0], operands[0])
        if operation not in PLAIN:
            return None
        varying.append(Instruction(operation, operands, step.target))
    return varying


def _placed(
    varying: Iterable[Instruction], row: dict[int, int], kept: Collection[int]
) -> tuple[list[tuple[int, int, int, int]], int]:
    """Give every result a row, in ``row``; those that nothing reads any more are used again.

    No result takes the row of an operand, so that the loops of the kernel may run on vectors.
    """
    varying = list(varying)
    given, rows = set(row), len(row)
    free: list[int] = []
    reader = {k: t for t, step in enumerate(varying) for k in step.operands}
    tape = []
    for t, step in enumerate(varying):
        if free:
            row[step.target] = free.pop()
        else:
            row[step.target], rows = rows, rows + 1
        a, b = row[step.operands[0]], row[step.operands[-1]]
        tape.append((PLAIN.index(step.operation), a, b, row[step.target]))
        read = {k for k in step.operands if reader[k] == t} - given
        free += [row[k] for k in read.difference(kept)]
    return tape, rows

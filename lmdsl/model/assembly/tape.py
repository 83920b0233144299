"""The compiled loop of :mod:`lmdsl.model.assembly.lines`: instructions, cells and costs."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.formulas.operations import PLAIN
from lmdsl.machine.kernels import kernel
from lmdsl.model.assembly.merging import add_cost, settle_cost
from lmdsl.model.grid.axis import circle, interval

# The codes of operations: their places among the plain ones.
ADD, SUBTRACT, MULTIPLY, DIVIDE, NEGATIVE, ABS, SQRT, FLOOR, CEIL = range(len(PLAIN))


class Tape(NamedTuple):
    """What is done line by line.

    Attributes
    ----------
    steps
        Code, rows of both operands and row of the result of every instruction, shape (., 4).
    constants
        The values of the rows that follow those of the inputs.
    inputs, rows
        Number of rows that hold inputs, and of all.
    """

    steps: Indices
    constants: Floats
    inputs: int
    rows: int


class Located(NamedTuple):
    """Rows to locate, shape (a,), the numbers of their axes, shape (a, 6), and whether to clip."""

    rows: Indices
    axes: Floats
    clip: bool


class Inputs(NamedTuple):
    """Small arrays one after the other.

    Attributes
    ----------
    flat
        All their elements.
    start, stride
        Where each begins, and its elements between neighbours on each of the four axes, 0 on those
        it does not depend on; shapes (inputs,) and (inputs, 4).
    """

    flat: Floats
    start: Indices
    stride: Indices

    @classmethod
    def of(cls, arrays: Sequence[Floats]) -> Self:
        """Put arrays one after the other."""
        start, stride = np.zeros(len(arrays), np.int64), np.zeros((len(arrays), 4), np.int64)
        used = 0
        for k, array in enumerate(arrays):
            start[k], step = used, 1
            for axis in range(1, array.ndim + 1):
                stride[k, -axis] = step if array.shape[-axis] > 1 else 0
                step *= array.shape[-axis]
            used += step
        flat = np.concatenate([np.zeros(0), *(array.reshape(-1) for array in arrays)])
        return cls(flat, start, stride)


@kernel(allocates=True)
def run(long, tape, packed, shape, located, index, cost_at, weights, mean):  # type: ignore[no-untyped-def]
    """Fill ``index`` and ``mean``, those of length 0 apart; see :meth:`Lines.__call__`.

    Parameters
    ----------
    long
        Samples at a time.
    tape, packed, shape, located
        :class:`Tape`, :class:`Inputs`, the shape of the block, :class:`Located`. One more input
        than the tape has is added to the indices of every sample.
    cost_at
        Row of the cost.
    """
    (steps, constants, inputs, rows), (flat, start, stride) = tape, packed
    first, points, nodes, last = shape
    work, least = np.empty((rows, long)), np.zeros(mean.shape)
    for c in range(len(constants)):
        work[inputs + c, :] = constants[c]
    for s in range(points * nodes):
        p, q = s // nodes, s % nodes
        for j in range(0, last, long):
            n = min(long, last - j)
            for i in range(first):
                for k in range(inputs):
                    if i == 0 or stride[k, 0] > 0:
                        at = start[k] + i * stride[k, 0] + p * stride[k, 1] + q * stride[k, 2]
                        _load(flat, at + j * stride[k, 3], stride[k, 3], work[k][:n])
                _compute(steps, work, n)
                if len(index):
                    line = index[i, s, j : j + n]
                    line[:] = 0.0
                    for k in range(inputs, len(start)):
                        at = start[k] + i * stride[k, 0] + p * stride[k, 1] + q * stride[k, 2]
                        _load(flat, at + j * stride[k, 3], stride[k, 3], line)
                    for a in range(len(located.rows)):
                        _locate(work[located.rows[a]][:n], located.axes[a], located.clip, line)
                if len(mean):
                    add_cost(work[cost_at], weights[q], mean[i, j : j + n], least[i, j : j + n])
    total = points * weights.sum()
    for i in range(len(mean)):
        settle_cost(mean[i], least[i], total)


@kernel
def _load(flat, at, step, line):  # type: ignore[no-untyped-def]
    if step == 0:
        line[:] = flat[at]
    else:
        for j in range(len(line)):
            line[j] = flat[at + j]


@kernel
def _locate(image, axis, clip, index):  # type: ignore[no-untyped-def]
    """Add the indices on one axis; ``axis`` has the fields of :class:`AxisCells`."""
    low, high, width, cells, stride = axis[0], axis[1], axis[2], axis[3], axis[4]
    if axis[5] > 0.0:
        circle(image, low, high, width, cells, stride, index)
    else:
        interval(image, low, high, width, cells, stride, clip, index)


@kernel
def _compute(tape, work, n):  # type: ignore[no-untyped-def]
    """Do the instructions on the first n samples of all rows."""
    for t in range(len(tape)):
        x, y, z = work[tape[t, 1]], work[tape[t, 2]], work[tape[t, 3]]
        code = tape[t, 0]
        if code == ADD:
            for j in range(n):
                z[j] = x[j] + y[j]
        elif code == SUBTRACT:
            for j in range(n):
                z[j] = x[j] - y[j]
        elif code == MULTIPLY:
            for j in range(n):
                z[j] = x[j] * y[j]
        elif code == DIVIDE:
            for j in range(n):
                z[j] = x[j] / y[j]
        elif code == NEGATIVE:
            for j in range(n):
                z[j] = -x[j]
        elif code == ABS:
            for j in range(n):
                z[j] = abs(x[j])
        elif code == SQRT:
            for j in range(n):
                z[j] = np.sqrt(x[j])
        elif code == FLOOR:
            for j in range(n):
                z[j] = np.floor(x[j])
        elif code == CEIL:
            for j in range(n):
                z[j] = np.ceil(x[j])

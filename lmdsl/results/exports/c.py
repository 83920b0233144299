"""The controller as a C header: a table of the control of every cell, and how to look it up.

Plain C99 with nothing but ``math.h``, ``stdint.h``: a state is wrapped or clipped, located and
answered by the arithmetic of grid/axis.py, to the same bits where the compiler does not contract
products and sums (``-ffp-contract=off``). The table has a code for every cell: 0 without control,
1 + i under control i, 1 + M + k on attractor cells under the feedback around orbit point k. It is
packed into bits or written as runs of equal codes, whichever is smaller.
"""

import os
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.common.types import Floats, Indices
from lmdsl.control.controller import Controller
from lmdsl.errors import BadInput, printable
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.partition import Partition
from lmdsl.model.lp import StabilizationLP
from lmdsl.results.directory import archive
from lmdsl.results.directory.writing import refuse_own_file
from lmdsl.results.exports import c_source
from lmdsl.results.result import Result

LINE = 8  # numbers a line
PART = 2**16  # words written at a time


@own_arithmetic
def export_c(result: Result, path: str | os.PathLike[str]) -> None:
    """Write the feedback controller as one C header.

    Parameters
    ----------
    result
        An answer with a controller.
    path
        The file to write; it appears whole or not at all.

    Notes
    -----
    ``int lmdsl_control(const double *x, double *u)`` gives the control at a state, as
    :class:`Controller` does: it returns the index of the control, ``LMDSL_LOCAL`` where the local
    feedback acts, or -1, with ``u`` NaN, where there is no control. Its time does not depend on
    the state but for a binary search among the runs.

    Raises
    ------
    BadInput
        The result has no controller, or the file cannot be written.
    """
    inputs.kind(result, Result, "result", "a Result")
    if not (result.control_index >= 0).any():
        raise BadInput("there is no controller to export: " + result.message)
    refuse_own_file(inputs.path(path))
    write_whole(inputs.path(path), _text(result))


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write the controller of a result for ``lmdsl export``."""
    export_c(result, path)


class _Table(NamedTuple):
    """Codes of the cells: words, and what stands in them."""

    name: str
    declared: list[tuple[str, str, NDArray[np.unsignedinteger]]]  # type, name, numbers
    bits: int

    @property
    def bytes(self) -> int:
        """Size of the table."""
        return sum(numbers.nbytes for _, _, numbers in self.declared)


def digest(result: Result) -> str:
    """Return the digest of the model by which a result directory names it."""
    return result.model_sha256 if result.lp is None else archive.identity(result.lp)


def codes(controller: Controller) -> Indices:
    """Return the code of every cell, shape (N,): see the module."""
    code = controller.index.astype(np.int64) + 1
    if controller.local is not None:
        cells = np.flatnonzero(controller.local.attractor & (controller.index < 0))
        code[cells] = 1 + len(controller.vectors) + controller.local.owner(cells)
    return code


def table(code: Indices) -> _Table:
    """Return the smaller of two tables of codes: packed into bits, or as runs of equal ones."""
    bits = max(int(code.max(initial=0)).bit_length(), 1)
    first = np.flatnonzero(np.diff(code, prepend=-1))
    size = next(k for k in (8, 16, 32) if bits <= k)
    if len(first) * (4 + size // 8) < (bits * len(code) + 31) // 32 * 4:
        kind = {8: np.uint8, 16: np.uint16, 32: np.uint32}[size]
        return _Table("runs", [
            ("uint32_t", "lmdsl_run", first.astype(np.uint32)),
            (f"uint{size}_t", "lmdsl_code", code[first].astype(kind)),
        ], bits)  # fmt: skip
    return _Table("bits", [("uint32_t", "lmdsl_code", packed(code, bits))], bits)


def packed(code: Indices, bits: int) -> NDArray[np.uint32]:
    """Return codes of so many bits one after another in words, lowest bits first."""
    words = np.zeros((len(code) * bits + 31) // 32 + 1, dtype=np.uint32)  # one more, to be read
    at = np.arange(len(code), dtype=np.int64) * bits
    shifted = code.astype(np.uint64) << (at % 32).astype(np.uint64)
    np.bitwise_or.at(words, at // 32, (shifted & np.uint64(2**32 - 1)).astype(np.uint32))
    np.bitwise_or.at(words, at // 32 + 1, (shifted >> np.uint64(32)).astype(np.uint32))
    return words


def _text(result: Result) -> Iterator[bytes]:
    controller, partition = result.controller, result.controller.partition
    codes_, p = table(codes(controller)), controller.vectors.shape[1]
    yield _head(result, codes_).encode()
    yield _axes(partition, result.problem.controls, codes_, len(controller.vectors)).encode()
    yield _matrix("lmdsl_vector", controller.vectors).encode()
    for kind, name, numbers in codes_.declared:
        yield f"static const {kind} {name}[{len(numbers)}] = {{\n".encode()
        for start in range(0, len(numbers), PART):
            yield _lines([f"{int(n)}u" for n in numbers[start : start + PART]]).encode()
        yield b"};\n\n"
    local = controller.local
    if local is not None:
        q, d = local.orbit.shape
        orbit, gain = local.orbit, local.gain.reshape(q * p, d)
        for name, matrix in (("orbit", orbit), ("at", local.control), ("gain", gain)):
            yield _matrix(f"lmdsl_{name}", matrix).encode()
        yield _matrix("lmdsl_least", local.low[None, :]).encode()
        yield _matrix("lmdsl_most", local.high[None, :]).encode()
    yield c_source.LOOK_UP[codes_.name].encode()
    yield c_source.LOCATE.encode()
    if local is not None:
        yield c_source.LOCAL.encode()
    yield (c_source.CONTROL_LOCAL if local is not None else c_source.CONTROL).encode()
    yield b"\n#endif\n"


def _head(result: Result, codes_: _Table) -> str:
    name = printable(result.problem.name or "unnamed").replace("*/", "* /").replace("\\", "/")
    kinds = {"bits": f"{codes_.bits} bits a cell", "runs": "runs of equal cells"}
    return (
        "/* A feedback controller, constant on cells; written by lmdsl.\n"
        f" * problem: {name.replace('??', '? ?')}\n"
        f" * model: {digest(result)}\n"
        f" * status: {result.status}\n"
        f" * table: {codes_.bytes} bytes, {kinds[codes_.name]}\n"
        " * C99; do not let the compiler contract products and sums: -ffp-contract=off\n"
        " */\n#ifndef LMDSL_CONTROLLER_H\n#define LMDSL_CONTROLLER_H\n\n"
        "#include <math.h>\n#include <stdint.h>\n\n"
    )


def _axes(partition: Partition, controls: tuple[str, ...], codes_: _Table, vectors: int) -> str:
    d, p = partition.dimension, len(controls)
    axes = "".join(
        f"    {{{_number(a.low)}, {_number(a.high)}, {_number(a.width)}, {int(a.cells)}, "
        f"{int(a.stride)}, {int(a.periodic)}}}, /* {name} */\n"
        for a, name in zip(partition.axes, partition.names, strict=True)
    )
    return (
        f"#define LMDSL_STATES {d} /* {', '.join(partition.names)} */\n"
        f"#define LMDSL_CONTROLS {p} /* {', '.join(controls)} */\n"
        f"#define LMDSL_CELLS {partition.size}\n"
        f"#define LMDSL_VECTORS {vectors}\n"
        f"#define LMDSL_LOCAL {vectors} /* returned where the local feedback acts */\n"
        f"#define LMDSL_BITS {codes_.bits}\n"
        f"#define LMDSL_CLIP {int(partition.clip)}\n\n"
        "typedef struct {\n"
        "    double low, high, width, cells, stride;\n    int periodic;\n} lmdsl_axis_t;\n\n"
        f"static const lmdsl_axis_t lmdsl_axis[{d}] = {{\n{axes}}};\n\n"
    )


def _matrix(name: str, rows: Floats) -> str:
    columns = max(rows.shape[1], 1)
    numbers = [_number(float(x)) for x in rows.ravel()] or ["0.0"]
    count = max(rows.shape[0], 1)
    return f"static const double {name}[{count} * {columns}] = {{\n{_lines(numbers)}}};\n\n"


def _lines(numbers: list[str]) -> str:
    rows = (numbers[k : k + LINE] for k in range(0, len(numbers), LINE))
    return "".join(f"    {', '.join(row)},\n" for row in rows)


def _number(x: float) -> str:
    return float(x).hex()

"""The vectors of a result, by cell of the box: in one archive, or each in a file of its own.

One process writes solution.npz. What several ranks write at a time, or is too much for the memory
of one machine, are files NAME.npy of the same arrays; these are mapped, not read.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import arrays
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.results.directory.reading import APART, Reading

ARCHIVE = "solution.npz"
TYPES = {
    "control_index": "<i4",
    "value": "<f8",
    "lower": "<f8",
    "measure": "<f8",
    "cell_status": "|u1",
    "witness": "<f8",
}


def types(problem: Problem) -> dict[str, str]:
    """Return the types of the vectors of a problem's result."""
    return TYPES | ({"sure_levels": "<i4"} if problem.successors == "enclosed" else {})


def expected(problem: Problem, N: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return their shapes and types."""
    return {name: ((N,), kind) for name, kind in types(problem).items()}


def read(files: Reading, problem: Problem, N: int) -> dict[str, NDArray[Any]]:
    """Return the vectors of a save, mapped where each is a file of its own.

    BadInput: one is missing, or is not exactly of its shape and type.
    """
    wanted = expected(problem, N)
    if not apart(files):
        memory.require(64 * N, "arrays of the result")
        return files.arrays(ARCHIVE, wanted)
    if N >= 2**31:
        raise BadInput(f"{N} cells; at most {2**31 - 1}", "problem.json")
    return {
        name: arrays.mapped(files.open(f"{name}.npy"), f"{name}.npy", shape, kind)
        for name, (shape, kind) in wanted.items()
    }


def apart(files: Reading) -> bool:
    """Return whether every vector of a save is a file of its own."""
    return ARCHIVE not in files.digests and bool(set(APART).intersection(files.digests))


def require_codes(index: NDArray[np.int32], status: NDArray[np.uint8], controls: int) -> None:
    """Refuse controls and statuses that there are not."""
    if index.size and not (index.min() >= -1 and index.max() < controls):
        raise BadInput("control_index holds an index outside the control grid", ARCHIVE)
    if status.max(initial=0) > max(CellStatus):
        raise BadInput("cell_status holds an unknown code", ARCHIVE)

"""What is known of every cell as a table, and the table as a file of comma-separated values."""

import os
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.common.types import Floats
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.results.directory.writing import refuse_own_file
from lmdsl.results.result import Result

PART = 2**14  # cells written at a time


@own_arithmetic
def export_csv(result: Result, path: str | os.PathLike[str]) -> None:
    """Write what is known of every cell, a line for each, as comma-separated values.

    Parameters
    ----------
    result
        An answer of any status.
    path
        The file to write; it appears whole or not at all.

    Notes
    -----
    The columns are those of :func:`columns`. Numbers have all their digits; infinity is ``inf``,
    and a control that is not there is empty.

    Raises
    ------
    BadInput
        The file cannot be written.
    """
    inputs.kind(result, Result, "result", "a Result")
    refuse_own_file(inputs.path(path))
    write_whole(inputs.path(path), _lines(columns(result)))


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write the table of a result for ``lmdsl export``."""
    export_csv(result, path)


def columns(result: Result) -> dict[str, NDArray[Any]]:
    """Return the columns of the table, shape (N,) each.

    ``cell``, its index; the centre by axis; ``status``, in words; ``control_index``; the controls
    at the centre by name, NaN where there is none; ``value``, ``lower`` and ``measure``, as in
    :class:`Result`. Where an axis or a control has such a name, ours has a line behind it.
    """
    problem, partition = result.problem, result.partition
    cells = np.arange(partition.size)
    centres, u = partition.centres(cells), controls_at_centres(result)
    words = np.array([status.name.lower() for status in CellStatus])
    own = own_names(
        ("cell", "status", "control_index", "value", "lower", "measure"),
        (*problem.states, *problem.controls),
    )
    return {
        own["cell"]: cells,
        **dict(zip(problem.states, centres.T, strict=True)),
        own["status"]: words[result.cell_status],
        own["control_index"]: result.control_index,
        **dict(zip(problem.controls, u.T, strict=True)),
        **{own[name]: getattr(result, name) for name in ("value", "lower", "measure")},
    }


def own_names(names: Iterable[str], taken: Iterable[str]) -> dict[str, str]:
    """Return each name as it is called, with lines behind it until it is none that is taken."""
    found, used = {}, {*taken}
    for name in names:
        called = name
        while called in used:
            called += "_"
        found[name] = called
        used.add(called)
    return found


def controls_at_centres(result: Result) -> Floats:
    """Return the control at the centre of every cell, shape (N, p), NaN where there is none."""
    cells = np.arange(result.partition.size)
    return result.controller.at(cells, result.partition.centres(cells))


def _lines(table: dict[str, NDArray[Any]]) -> Iterator[bytes]:
    yield (",".join(table) + "\n").encode()
    count = len(next(iter(table.values())))
    for first in range(0, count, PART):
        texts = [_texts(column[first : first + PART]) for column in table.values()]
        yield "".join(",".join(row) + "\n" for row in zip(*texts, strict=True)).encode()


def _texts(column: NDArray[Any]) -> list[str]:
    if column.dtype.kind == "f":
        return ["" if x != x else repr(x) for x in column.tolist()]
    return [str(x) for x in column.tolist()]

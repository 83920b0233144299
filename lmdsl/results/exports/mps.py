"""The linear program in free MPS format, which every solver reads."""

from pathlib import Path

import numpy as np

from lmdsl.common.files import write_whole
from lmdsl.errors import BadInput
from lmdsl.model.lp import StabilizationLP
from lmdsl.results.result import Result


def export_mps(lp: StabilizationLP, path: Path) -> None:
    """Write an LP in free MPS format; see :meth:`StabilizationLP.write_mps`."""
    if not lp.n:
        raise BadInput("the stabilizable set is empty; there is no LP to write")
    A = lp.A
    lines = ["NAME lmdsl", "ROWS", " N cost", *(f" E d{i}" for i in lp.cells), "COLUMNS"]
    names = [f"d{i}" for i in lp.cells]
    cell = lp.cells[lp.cell]
    for k in range(lp.K):
        column = f" t{cell[k]}_{lp.control[k]}"
        lines.append(f"{column} cost {float(lp.cost[k])!r}")
        span = slice(A.indptr[k], A.indptr[k + 1])
        lines += [
            f"{column} {names[i]} {float(v)!r}"
            for i, v in zip(A.indices[span], A.data[span], strict=True)
        ]
    lines.append("RHS")
    lines += [f" m {names[i]} {float(lp.b[i])!r}" for i in np.flatnonzero(lp.b)]
    write_whole(path, ("\n".join([*lines, "ENDATA"]) + "\n").encode())


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write the LP of a result for ``lmdsl export``."""
    export_mps(lp, Path(path))

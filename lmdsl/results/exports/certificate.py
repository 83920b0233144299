"""A certificate as one text file that holds everything it speaks of, to be checked without lmdsl.

One JSON value per line: a head, a line per cell of C, a line per surviving pair. Numbers are exact:
doubles in hexadecimal, transitions as integers over the total of the head. See docs/exports.md.
"""

import json
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.errors import BadInput
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize.feasibility.restriction import restricted
from lmdsl.results.directory.writing import refuse_own_file
from lmdsl.results.exports.true_map import described
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status

FORMAT = "lmdsl-certificate/1"
VECTORS = {"V_up": "value", "W": "lower", "w": "stability_vector", "mu": "measure"}


@own_arithmetic
def export_certificate(
    result: Result, path: str | os.PathLike[str], lp: StabilizationLP | None = None
) -> None:
    """Write the policy, its vectors and every surviving pair as one self-contained text file.

    Parameters
    ----------
    result
        An answer with a controller, or a refusal because of gamma.
    path
        The file to write; it appears whole or not at all.
    lp
        The finite model; by default the result's own, compiled anew for a result read from a
        directory.

    Raises
    ------
    BadInput
        The result has neither a controller nor a refusal that vectors prove, it is not about this
        model, or the file cannot be written.
    """
    inputs.kind(result, Result, "result", "a Result")
    refused = result.status == Status.NOT_STABILIZABLE
    if refused and result.cause != Cause.GAMMA:
        raise BadInput(
            f"this refusal ({result.cause}) follows from the graph of the model, not from vectors; "
            "`lmdsl verify` checks it"
        )
    if lp is None:
        lp = result.lp if result.lp is not None else compile(result.problem)
    if len(result.control_index) == lp.partition.size:
        lp = _part(lp, result)
    else:
        raise BadInput("the result and the model have different cells")
    if not refused and (result.control_index[lp.cells] < 0).any():
        raise BadInput("there is no controller to export: " + result.message)
    refuse_own_file(inputs.path(path))
    write_whole(inputs.path(path), _lines(_head(result, lp, refused), result, lp, refused))


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write a result for ``lmdsl export``."""
    export_certificate(result, path, lp)


def _part(lp: StabilizationLP, result: Result) -> StabilizationLP:
    """Return the part of the model that a result restricted to its gamma speaks of."""
    beyond = result.cell_status[lp.cells] == CellStatus.BEYOND_GAMMA
    if not beyond.any():
        return lp
    return restricted(lp, np.where(beyond, result.refusal_vector[lp.cells], 0.0)) or lp


def _head(result: Result, lp: StabilizationLP, refused: bool) -> dict[str, Any]:
    head: dict[str, Any] = {
        "format": FORMAT,
        "kind": "refusal" if refused else "policy",
        "name": result.problem.name,
        "model_sha256": lp.digest,
        "gamma": lp.gamma.hex(),
        "total": lp.rows.shares.total,
        "cells": lp.n,
        "pairs": lp.K,
    }
    if result.problem.discount is not None:
        head["discount"] = result.problem.discount.hex()
    if lp.problem.system.assumes:
        head["assumes"] = lp.problem.system.assumes
    if not refused:
        for name in ("tolerance", "cost", "lower_bound", "contraction"):
            value = getattr(result, name)
            head[name] = None if value is None else float(value).hex()
        if lp.problem.successors == "enclosed" and "system" not in lp.problem.functions:
            head["map"] = described(lp)
    return head


def _lines(
    head: dict[str, Any], result: Result, lp: StabilizationLP, refused: bool
) -> Iterator[bytes]:
    yield _line(head)
    names = {"w": "refusal_vector"} if refused else VECTORS
    vectors = {key: getattr(result, name) for key, name in names.items()}
    for i, cell in enumerate(lp.cells):
        entry: dict[str, Any] = {"cell": int(cell)}
        if not refused:
            entry |= {"policy": int(result.control_index[cell]), "m": float(lp.weight[i]).hex()}
        entry |= {key: float(vector[cell]).hex() for key, vector in vectors.items()}
        yield _line(entry)
    owner = np.repeat(np.arange(lp.n), np.diff(lp.pair_pointer))
    for k in range(lp.K):
        pair = [int(owner[k]), int(lp.control[k]), float(lp.cost[k]).hex(), _row(lp, k)]
        yield _line(pair if lp.rows.shares.total is not None else [*pair, lp.rows.total(k)])


def _row(lp: StabilizationLP, k: int) -> list[list[int]]:
    """Return a row as [target, numerator]; n is A, n + 1 the end of the run by discount."""
    row = [list(entry) for entry in lp.rows.exact(k)]
    if lp.rows.shares.ended is not None:
        row[-1][0] += 1  # the last entry
    return row


def _line(data: Any) -> bytes:
    return (json.dumps(data, separators=(", ", ": ")) + "\n").encode()

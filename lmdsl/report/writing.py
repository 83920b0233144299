"""Writing the page of a result: one file, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.common.optional import installed
from lmdsl.common.types import Progress, told
from lmdsl.errors import BadInput, LmdslError, MissingDependency, plain_text, shown
from lmdsl.machine import memory
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize.feasibility.restriction import restricted
from lmdsl.proof.record import Proof
from lmdsl.report.gathering import Beside, gathered
from lmdsl.report.page import page
from lmdsl.results.comparison import Comparison
from lmdsl.results.directory import archive, writing
from lmdsl.results.result import Result
from lmdsl.results.verification import Verification, recompiled, verify

ENDINGS = (".html", ".htm")
EACH = 400.0  # bytes a cell, at most


@own_arithmetic
def write(
    result: Result,
    path: str | os.PathLike[str],
    *,
    proof: Proof | None = None,
    comparison: Comparison | None = None,
    seed: int = 0,
    progress: Progress | bool | None = None,
) -> None:
    """Write one page about a result; see :meth:`Result.report`."""
    progress = told(progress)
    inputs.kind(result, Result, "result", "a Result")
    if proof is not None:
        inputs.kind(proof, Proof, "proof", "what Result.prove returns")
        if len(proof.cell) and int(proof.cell.max()) >= result.partition.size:
            raise BadInput("it is a proof of another result", "proof")
    if comparison is not None:
        inputs.kind(comparison, Comparison, "comparison", "what lmdsl.compare returns")
    lp, missing = _model(result, lambda: compile(result.problem, progress, dropped=result.dropped))
    asked = Beside(lp, proof or result.proof, comparison, missing=missing)
    _write(result, path, asked, inputs.seed(seed), progress)


@own_arithmetic
def write_directory(
    directory: str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    *,
    check: bool = False,
    backends: tuple[str, ...] = (),
    seed: int = 0,
    time_limit: float | None = None,
    progress: Progress | bool | None = None,
) -> tuple[Path, Verification | None]:
    """Write one page about a result directory; return where, and what checking it found.

    Parameters
    ----------
    directory
        The result directory.
    path
        The file; default ``report.html`` in the directory.
    check
        Whether every claim is checked anew, as by :func:`lmdsl.verify`.
    backends
        Backends to compare, as for :func:`lmdsl.compare`.
    seed
        Of the runs.
    time_limit
        Seconds for compiling the model, for checking, and for each backend.
    progress
        Called with (stage, fraction done, or -1); True shows it on stderr.
    """
    progress = told(progress)
    from lmdsl.results.comparison import compare

    target = Path(directory) / "report.html" if path is None else inputs.path(path)
    _refuse_ending(target)
    _library()  # before the work
    stored = archive.read(directory)
    result = stored.result
    lp, missing = _model(result, lambda: recompiled(directory, result, progress, time_limit))
    found = verify(directory, progress=progress, time_limit=time_limit) if check else None
    comparison = None
    if backends:
        comparison = compare(
            result.problem if lp is None else lp, backends, time_limit=time_limit,
            progress=progress,
        )  # fmt: skip
    made_by = stored.certificate.versions
    asked = Beside(lp, result.proof, comparison, found, str(directory), missing, made_by)
    _write(result, target, asked, inputs.seed(seed), progress)
    return target, found


def _model(
    result: Result, make: Callable[[], StabilizationLP]
) -> tuple[StabilizationLP | None, str]:
    """Return the model of a result, made anew where it has none, or why there is none."""
    if result.lp is not None:
        return result.lp, ""
    try:
        lp = make()
    except (LmdslError, MemoryError) as error:
        return None, f"spectrum and decay: the model was not compiled: {plain_text(error)}"
    beyond = result.cell_status[lp.cells] == CellStatus.BEYOND_GAMMA
    if not beyond.any():
        return lp, ""
    return restricted(lp, np.where(beyond, result.refusal_vector[lp.cells], 0.0)) or lp, ""


def _write(
    result: Result,
    path: str | os.PathLike[str],
    asked: Beside,
    seed: int,
    progress: Progress | None,
) -> None:
    target = inputs.path(path)
    _refuse_ending(target)
    writing.refuse_own_file(target)
    library = _library()
    memory.require(EACH * result.partition.size + 1e8, "the report")
    content = page(gathered(result, asked, seed, progress), library)
    write_whole(target, content.encode("utf-8", "replace"))


def _refuse_ending(target: Path) -> None:
    if target.suffix.lower() not in ENDINGS:
        raise BadInput(f"{shown(str(target), 200)}: a report ends in .html")


def _library() -> str:
    """Return the source of plotly.js, as the package plotly holds it."""
    found = find_spec("plotly")
    for place in (found.submodule_search_locations or ()) if found else ():
        file = Path(place) / "package_data" / "plotly.min.js"
        if file.is_file():
            return file.read_text(encoding="utf-8")
    raise MissingDependency(f"reports need plotly: {installed('report')}")

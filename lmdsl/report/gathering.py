"""Everything that a page says of a result, as plain data that strict JSON can hold."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lmdsl.common.types import Progress
from lmdsl.control.loop import REACHED, draw_starts
from lmdsl.errors import LmdslError, plain_text
from lmdsl.explanation.causes import Explanation
from lmdsl.explanation.meanings import meanings
from lmdsl.explanation.one_cell import NAMES
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.boxes import Area
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.proof.record import TARGET, Proof
from lmdsl.report.browser import map_of, rows_of, samples_of
from lmdsl.report.cells import cells_of
from lmdsl.report.claims import claims_of
from lmdsl.report.decay import closed_loop_of
from lmdsl.report.declared import problem_of
from lmdsl.results.comparison import Comparison
from lmdsl.results.result import Result
from lmdsl.results.verification import Verification

STARTS, STEPS = 1_000, 10_000  # runs of the true map that a page tells of
SECONDS = 10.0  # for them, for the spectrum, and for what explains a lost cell: each
SHOWN = 6  # runs that are drawn when a page is opened
MOST_FILE = 200_000  # characters of a problem file that a page holds


class Beside(NamedTuple):
    """What a page is made of beside the result.

    Attributes
    ----------
    lp
        The compiled model; None where it is not at hand.
    proof, comparison, verification
        What :meth:`Result.prove`, :func:`lmdsl.compare` and :func:`lmdsl.verify` found, if asked.
    directory
        Where the result was read; empty for one that was just found.
    missing
        Why there is no model, a sentence.
    made_by
        The versions that a directory names as those that made it.
    """

    lp: StabilizationLP | None = None
    proof: Proof | None = None
    comparison: Comparison | None = None
    verification: Verification | None = None
    directory: str = ""
    missing: str = ""
    made_by: Mapping[str, str] | None = None


class _Attempts:
    """Work that may fail without taking the page along: what is left out is noted."""

    def __init__(self, notes: list[str], progress: Progress | None) -> None:
        self.notes, self.progress = notes, progress

    def __call__(self, stage: str, work: Callable[..., Any], *arguments: Any) -> Any:
        if self.progress:
            self.progress(stage, -1.0)
        try:
            return work(*arguments)
        except (LmdslError, MemoryError) as error:
            self.notes.append(f"{stage}: {plain_text(error) or 'out of memory'}")
            return None


def gathered(
    result: Result, asked: Beside, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Return all that a page says; what cannot be found out is left out with a note."""
    notes: list[str] = [asked.missing] if asked.missing else []
    tried = _Attempts(notes, progress)
    if (result.control_index >= 0).any() and result.simulation is None:
        runs = tried("simulate", lambda: result.simulate(STARTS, STEPS, seed, time_limit=SECONDS))
        result = replace(result, simulation=runs)
    return {
        "problem": {"name": result.problem.name, **problem_of(result), "file": _file(result)},
        "result": result.to_dict(),
        "scope": result.problem.system.scope,
        "assumes": result.problem.system.assumes,
        "reasons": list(result.certificate.reasons),
        "claims": claims_of(result, asked.proof),
        "cells": cells_of(result, asked.proof),
        **_motion(result, asked, seed, tried),
        "lost": tried("explain", _lost, result) or [],
        "comparison": None if asked.comparison is None else asked.comparison.to_dict(),
        "proof": None if asked.proof is None else asked.proof.text(),
        "verification": None if asked.verification is None else asked.verification.to_dict(),
        "repeat": _repeat(result, asked, seed),
        "notes": notes,
    }


def _motion(result: Result, asked: Beside, seed: int, tried: _Attempts) -> dict[str, Any]:
    """Return what moves: the map or its rows, starts, and the closed loop of the model."""
    step = tried("map", map_of, result.problem)
    found: dict[str, Any] = {
        "map": step,
        "samples": None if step is None else tried("samples", samples_of, result.problem),
        **dict.fromkeys(("rows", "starts", "loop", "survival")),
    }
    if not (result.control_index >= 0).any():
        return found
    found["starts"] = tried("starts", _starts, result, seed)
    found["survival"] = tried("simulate", _survival, result, seed)
    if asked.lp is not None:
        found["loop"] = tried("spectrum", closed_loop_of, result, asked.lp, Deadline.of(SECONDS))
        if step is None:
            found["rows"] = tried("rows", rows_of, result, asked.lp)
    return found


def _file(result: Result) -> str | None:
    """Return the problem file; None where no file holds the problem, or it is too long."""
    try:
        text = result.problem.to_json()
    except LmdslError:  # a Python function, or matrices
        return None
    return text if len(text) <= MOST_FILE else None


def _starts(result: Result, seed: int) -> list[list[float]] | None:
    cells = np.flatnonzero(result.weight)
    if not len(cells):
        return None
    rng = np.random.default_rng(seed)
    return [list(map(float, x)) for x in
            draw_starts(result.partition, cells, result.weight[cells], SHOWN, rng)]  # fmt: skip


def _survival(result: Result, seed: int) -> dict[str, list[float]] | None:
    """Return which share of true runs from m is not in A yet, by step.

    The longest of the runs that were simulated says how many steps are worth while.
    """
    cells, known = np.flatnonzero(result.weight), result.simulation
    if not len(cells) or known is None or known.steps is None:
        return None
    rng = np.random.default_rng(seed)
    x = draw_starts(result.partition, cells, result.weight[cells], STARTS, rng)
    runs = result.closed_loop.run(x, known.steps["max"], rng, Deadline.of(SECONDS))
    steps, count = np.unique(runs.taken[runs.outcome == REACHED], return_counts=True)
    left = 1 - np.cumsum(count) / STARTS
    return {"steps": [0.0, *map(float, steps)], "left": [1.0, *map(float, left)]}


def _lost(result: Result) -> list[dict[str, Any]]:
    """Return the cells that cannot be stabilized, by cause and region."""
    meaning, found = meanings(result.problem), []
    own = Explanation(result.problem, result.partition, result.cell_status, (), ())
    for code in LOST:
        area = Area.of(result.partition, np.flatnonzero(result.cell_status == code))
        if not len(area):
            continue
        asks = code != CellStatus.TRAPPED  # that asks for the transitions of all pairs
        found.append({
            "name": NAMES[code], "cells": len(area), "meaning": meaning[NAMES[code]],
            "regions": [{"box": str(region), "cells": region.cells,
                         "why": _why(own, region.cell) if asks else ""}
                        for region in area.regions],
            "elsewhere": area.elsewhere,
        })  # fmt: skip
    if result.beyond_gamma is not None:
        area = result.beyond_gamma
        found.append({
            "name": "no finite cost", "cells": len(area), "elsewhere": area.elsewhere,
            "meaning": f"no control law has a finite cost there at gamma = {result.gamma!r}",
            "regions": [{"box": str(region), "cells": region.cells, "why": ""}
                        for region in area.regions],
        })  # fmt: skip
    return found


def _why(explanation: Explanation, cell: int) -> str:
    """Return the first fact that blocks a cell; empty where it cannot be asked."""
    try:
        return explanation.why(cell).first
    except (LmdslError, MemoryError):
        return ""


def _proving(proof: Proof | None) -> str | None:
    """Return the options by which a proof comes about again; None without one."""
    if proof is None:
        return None
    target = "" if proof.target == TARGET else f" --target {proof.target!r}"
    return target + " --bracket" * (proof.nonnegative is not None)


def _repeat(result: Result, asked: Beside, seed: int) -> dict[str, Any]:
    """Return how the result and this page come about again."""
    from lmdsl.results.directory.archive import identity, versions

    digest = result.model_sha256 or ("" if result.lp is None else identity(result.lp))
    return {
        "backend": result.backend,
        "gamma": result.gamma,
        "proved": None if result.proved is None else result.proved.target,
        "proof": _proving(asked.proof),
        "digest": digest,
        "versions": versions(),
        "made_by": dict(asked.made_by or {}),
        "directory": asked.directory,
        "fresh": result.lp is not None,
        "seed": seed,
    }

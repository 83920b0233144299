"""What a certificate.json says, compared with what was found anew: every number that is a claim."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from lmdsl.certificate.checks import MEASURE_TOLERANCE
from lmdsl.certificate.claims import Certificate
from lmdsl.certificate.judge import CLAIMS
from lmdsl.common.records import jsonable
from lmdsl.control.invariance import SAMPLES, LocalCheck
from lmdsl.control.staying import check_of
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.boxes import Area
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize.feasibility import gamma_bar
from lmdsl.results.directory.certificate_file import CertificateFile, scope
from lmdsl.results.directory.recorded import data_differences, policy_of
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status
from lmdsl.systems import FunctionSystem

# What a verification says, of one process or of many.
OTHER_MODEL = "the recompiled model differs from the stored one; claims are judged on it"
OTHER_CELLS = "cell_status differs from the recompiled model"
OTHER_LEVELS = "sure_levels differ from the recompiled model"
NO_POLICY = "control_index is no policy on the stabilizable set"
NOT_REFUSED = "that gamma is infeasible from the cells left out is not proved"
UNPROVED = "the refusal ({}) is not proved by the recompiled model"
REWRITTEN = "{} was written anew since the save; what it holds now was judged"

_WEAKER = {"cost": 1e-9, "lower_bound": 1e-9, "gap": 1e-3, "contraction": 1e-9}
# By how much, relative, a stored number may be weaker than the one proved anew; by how much,
# relative and absolute, stronger.
_ROUNDING = {
    "cost": (1e-12, 0.0), "lower_bound": (1e-12, 0.0), "gap": (0.0, 1e-15),
    "contraction": (0.0, 1e-15),
}  # fmt: skip
_BRACKET = 2e-8  # relative excess over the bracket proved anew above which it is refused


def differences(
    whole: StabilizationLP,
    lp: StabilizationLP,
    result: Result,
    certificate: CertificateFile,
    found: Certificate,
) -> list[str]:
    """Return where a certificate says something else than what was found, one sentence each.

    ``whole`` is the recompiled model, ``lp`` the part of it that a restricted result speaks of.
    """
    reasons = [*counts(_counted(lp), result), *numbers(result, found)]
    law = lp.hold is not None and policy_of(lp, result) is not None
    reasons += said_of(outside(lp, result, law))
    sure = whole.sure_levels
    if sure is not None and not np.array_equal(np.asarray(result.sure_levels), sure):
        reasons.append(OTHER_LEVELS)
    reasons += facts(result, certificate, found, mass(lp, result), result.beyond_gamma)
    reasons += data_differences(lp, result)
    return reasons + bracket(result, found, whole.gamma, partial(gamma_bar.enclosed, whole))


def facts(
    result: Result,
    certificate: CertificateFile,
    found: Certificate,
    mass: float,
    beyond: Area | None,
) -> list[str]:
    """Return where a certificate says something else of what needs no model.

    ``mass`` is the sum of mu, ``beyond`` are the cells that the vectors prove infeasible.
    """
    reasons, claims = list[str](), certificate.claims
    for name in (*(claim.name for claim in CLAIMS), "safe"):
        if claims.get(name) is not getattr(found, name):
            reasons.append(_differs(f"claims.{name}", claims.get(name), getattr(found, name)))
    reasons += _residual(mass, certificate.measure_residual, found)
    if result.status == Status.VERIFIED and certificate.reasons:
        reasons.append("reasons are stored, but the status is verified")
    if result.status != Status.NOT_STABILIZABLE and result.cause is not None:
        reasons.append(f"cause is stored as {result.cause!r}, but nothing was refused")
    named = certificate.beyond_gamma
    if "beyond_gamma" in certificate.model_fields_set and named != jsonable(beyond):
        reasons.append("beyond_gamma is not the cells that solution.npz names")
    if "reward" in certificate.model_fields_set:
        reasons += _reward(certificate.reward, result.reward)
    if certificate.scope != scope(result.problem):
        reasons.append("scope is not what verified speaks of")
    return reasons


def _reward(stored: float | None, found: float | None) -> list[str]:
    """Compare the reward, which follows from the cost and the problem's ``best_reward``."""
    if stored is None or found is None:
        return [] if stored is found else [_differs("reward", stored, found)]
    if math.isclose(stored, found, rel_tol=1e-12, abs_tol=1e-300):
        return []
    return [f"{_differs('reward', stored, found)} by best_reward and cost"]


def _differs(name: str, stored: Any, found: Any) -> str:
    return f"{name} is stored as {stored!r}, but is {found!r}"


def _counted(lp: StabilizationLP) -> dict[str, float]:
    return {
        "gamma": lp.gamma,
        "cells": lp.partition.size,
        "controls": len(lp.controls),
        "pairs": lp.K,
        "attractor_cells": int((lp.cell_status == CellStatus.ATTRACTOR).sum()),
        "stabilizable_cells": lp.n,
    }


def counts(known: Mapping[str, float], result: Result) -> list[str]:
    """Return where a certificate counts otherwise than a model does."""
    return [
        _differs(name, getattr(result, name), count)
        for name, count in known.items()
        if getattr(result, name) != count
    ]


def numbers(result: Result, found: Certificate) -> list[str]:
    """Compare the four numbers: none may say more than is proved, nor much less."""
    now = {
        "cost": found.cost,
        "lower_bound": found.lower or 0.0,
        "gap": found.gap,
        "contraction": found.contraction,
    }
    if result.status == Status.NOT_STABILIZABLE:
        now = dict.fromkeys(now)
    reasons = []
    for name, true in now.items():
        stored = getattr(result, name)
        if stored is None and true is None:
            continue
        if stored is None or true is None or not np.isfinite(stored):
            reasons.append(_differs(name, stored, true))
            continue
        excess = true - stored if name == "lower_bound" else stored - true  # how much weaker
        most = _WEAKER[name] * abs(true) + (1e-11 if name in ("gap", "contraction") else 0.0)
        share, least = _ROUNDING[name]
        if not -(share * abs(true) + least) <= excess <= most:
            reasons.append(_differs(name, stored, true))
    return reasons


def mass(lp: StabilizationLP, result: Result) -> float:
    """Return the sum of mu on the cells of a model, about."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(result.measure[lp.cells].sum())


def _residual(mass: float, stored: float | None, found: Certificate) -> list[str]:
    true = found.measure_residual
    if stored is not None and true is not None and np.isfinite(true):
        scale = max(1.0, mass)
        if -1e-12 * scale <= stored - true <= MEASURE_TOLERANCE * scale and stored >= 0:
            return []
    elif stored == true:
        return []
    return [_differs("measure_residual", stored, true)]


# Of arrays by cell: what they hold on A, off C, and on C where gamma, or all, is refused.
_NOTHING = (
    ("value", 0.0, np.inf, np.inf),
    ("lower", 0.0, np.inf, 0.0),
    ("measure", 0.0, 0.0, 0.0),
    ("control_index", -1, -1, -1),
)


def outside(lp: StabilizationLP, result: Result, law: bool) -> list[bool]:
    """Return which arrays say something where there is nothing: off C, after a refusal on C.

    ``law`` tells whether all cells of C have a control: without one there is none on A either.
    """
    attractor = lp.cell_status == CellStatus.ATTRACTOR
    off_c = lp.cell_status > CellStatus.STABILIZED
    beyond = lp.cell_status == CellStatus.BEYOND_GAMMA
    wrong = []
    for name, on_attractor, off, refused in _NOTHING:
        array, on = getattr(result, name), np.full(len(attractor), on_attractor)
        if name == "control_index" and lp.hold is not None and law:
            on = lp.hold
        sound = (array[attractor] == on[attractor]).all() and (array[off_c] == off).all()
        if result.status == Status.NOT_STABILIZABLE:
            sound = sound and (array[lp.cells] == refused).all()
        wrong.append(not sound)
    return [*wrong, bool(result.witness[attractor | (off_c & ~beyond)].any())]


def said_of(wrong: Sequence[bool]) -> list[str]:
    """Return a sentence on every array that :func:`outside` found to be wrong."""
    sentences = [f"{name} has a wrong value where there is none to give" for name, *_ in _NOTHING]
    sentences.append("witness has a wrong value outside the stabilizable set")
    return [sentence for sentence, odd in zip(sentences, wrong, strict=True) if odd]


def bracket(
    result: Result,
    found: Certificate,
    gamma: float,
    enclosed: Callable[[float, float], tuple[float, float]],
) -> list[str]:
    """Prove the stored bracket of gamma_bar again, with vectors of our own.

    ``enclosed`` returns a proved one, which lies in the one that it is given if that can be shown.
    """
    stored = result.gamma_bar
    if stored is None:
        if result.cause == Cause.GAMMA:
            return ["gamma_bar is stored as null, but gamma was refused because of it"]
        return []
    low, high = enclosed(*stored)
    if found.refusal:
        high = min(high, gamma)
    if 0 <= stored[0] <= low * (1 + _BRACKET) and stored[1] >= high * (1 - _BRACKET):
        return []
    return [f"gamma_bar is stored as {list(stored)}, but only {[low, high]} is proved"]


# The local controller -------------------------------------------------------------------------


def local_differences(
    lp: StabilizationLP, result: Result, certificate: CertificateFile, deadline: Deadline
) -> list[str]:
    """Return where the local controller does less than the directory says."""
    stored, problem = result.local_controller, result.problem
    if "local_controller" not in certificate.model_fields_set:
        return []
    if stored is None or problem.local_controller is None:
        if stored is None and problem.local_controller is None:
            return []
        word = "no" if stored is None else "a"
        other = "one" if stored is None else "none"
        return [f"{word} local_controller is stored, but the problem names {other}"]
    attractor = lp.cell_status == CellStatus.ATTRACTOR
    samples = min(max(stored.samples, 0), SAMPLES)
    if isinstance(problem.system, FunctionSystem):  # which can be neither enclosed nor asked
        kept = min(max(stored.kept, 0), samples)
        cells, kind = int(attractor.sum()), problem.local_controller.kind
        holding = None if lp.hold is None else int((lp.hold >= 0).sum())
        found = LocalCheck(kind, stored.multiplier, cells, None, samples, kept, holding)
    else:
        checked = check_of(lp, deadline, samples)
        assert checked is not None
        found = checked
        deadline.raise_if_over("verifying")  # it ends with less than it could have found
    true = {
        "kind": stored.kind == found.kind,
        "multiplier": _close(stored.multiplier, found.multiplier),
        "cells": stored.cells == found.cells,
        "proved": (stored.proved or 0) <= (found.proved or 0),
        "samples": stored.samples == found.samples,
        "kept": stored.kept == found.kept,
        "holding": stored.holding == found.holding,
    }
    return [
        _differs(f"local_controller.{name}", getattr(stored, name), getattr(found, name))
        for name, holds in true.items()
        if not holds
    ]


def _close(a: float | None, b: float | None) -> bool:
    return a == b if a is None or b is None else math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)

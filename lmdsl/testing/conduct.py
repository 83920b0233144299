"""Checks of how a backend behaves: packages, names, options, limits, and what it leaves alone."""

import math
from dataclasses import fields
from importlib.util import find_spec
from typing import Any

import numpy as np

from lmdsl import backends
from lmdsl.backends import Stop
from lmdsl.errors import BadInput, LmdslError
from lmdsl.machine import quiet
from lmdsl.model.lp import StabilizationLP
from lmdsl.testing import known
from lmdsl.testing.probe import Broken, Probe, Unjudged, judge, misshapen

TIGHT = 1e-7  # relative error above which an answer asked for with this tolerance is wrong


UNKNOWN = "no such algorithm"


def requires(probe: Probe) -> None:
    """Every package that the record requires can be imported."""
    absent = [name for name in probe.backend.requires if not _importable(name)]
    if absent:
        raise Broken(f"no package {', '.join(absent)} can be imported")


def algorithms(probe: Probe) -> None:
    """The names of the algorithms are distinct, and an unknown one is refused with BadInput."""
    names = probe.backend.capabilities.algorithms
    if names:  # then the registry refuses all others
        if len(set(names)) < len(names) or not all(isinstance(n, str) and n for n in names):
            raise Broken("algorithms are not distinct names")
        return
    try:
        with quiet.foreign():
            probe.backend.solve(known.SMALL.compile(), backends.Options(algorithm=UNKNOWN))
    except BadInput:
        return
    except Exception as error:
        raise Broken(f"an unknown algorithm raises {type(error).__name__}, not BadInput") from error
    raise Broken("the record lists no algorithms, and an unknown one is not refused with BadInput")


def start(probe: Probe) -> None:
    """A first policy is used or ignored, and V is the same."""
    for one in (known.walk(60), known.SMALL):
        probe.right(one, start=one.own.tree[1].copy())


def tolerance(probe: Probe) -> None:
    """A tolerance of 1e-7 is reached."""
    probe.needs("tolerance")
    for one in (known.SMALL, known.walk(60)):
        lp, found = probe.solved(one, tolerance=TIGHT)
        if found.stop is Stop.OPTIMAL:
            judge(one, lp, found, TIGHT)


def time_limit(probe: Probe) -> None:
    """A time limit of a nanosecond ends the work, and is no success."""
    probe.needs("time_limit")
    _, found = probe.answer(known.LARGE, time_limit=1e-9)
    if found.stop.success:
        raise Broken(f"{found.stop.name} is claimed on 1000 cells within a nanosecond")
    if found.stop in (Stop.INFEASIBLE, Stop.UNBOUNDED):
        raise Broken(f"{found.stop.name} is claimed where time ran out")


def iteration_limit(probe: Probe) -> None:
    """One iteration is no success, unless the LP is really solved by then."""
    probe.needs("iteration_limit")
    for one in (known.SMALL, known.walk(60), known.LARGE):
        lp, found = probe.answer(one, max_iterations=1)
        if found.stop in (Stop.INFEASIBLE, Stop.UNBOUNDED):
            raise Broken(f"{found.stop.name} is claimed where the iterations ran out")
        if found.stop.success:
            judge(one, lp, found)
            if found.iterations is not None and found.iterations > 1:
                raise Broken(f"{found.iterations} iterations are made where 1 is allowed")


def options(probe: Probe) -> None:
    """Extreme and meaningless options are refused by an exception of lmdsl or do no harm."""
    nan, inf = math.nan, math.inf
    strange: list[dict[str, Any]] = [
        *({"tolerance": x} for x in (0.0, 1e9, -1.0, nan)),
        *({"time_limit": x} for x in (inf, 1e9, 0.0, -1.0, nan)),
        *({"max_iterations": x} for x in (10**12, 2**31 - 1, 0, -1)),
    ]
    noted = len(probe.malformed)
    for given in strange:
        lp = known.SMALL.own
        try:
            found = probe.raw(known.SMALL.compile(), **given)
        except LmdslError:
            continue
        except Unjudged:
            fault = probe.malformed.pop() if len(probe.malformed) > noted else "it raises"
            raise Broken(f"with {given}, {fault}") from None
        wrong = misshapen(lp, found)
        if wrong is None and found.stop.success and given.get("tolerance") != 1e9:
            try:
                judge(known.SMALL, lp, found)
            except Broken as broken:
                wrong = str(broken)
        if wrong is not None:
            raise Broken(f"with {given}, {wrong}")


def inputs(probe: Probe) -> None:
    """The arrays of the model and the first policy are what they were."""
    lp = known.SMALL.compile()
    first = lp.tree[1].copy()
    before = _bytes(lp, first)
    probe.ask(lp, start=first)
    changed = [name for name, content in _bytes(lp, first).items() if before[name] != content]
    if changed:
        raise Broken(f"it changes {', '.join(changed)}")


def deterministic(probe: Probe) -> None:
    """Asked twice it gives the same bytes."""
    for one in (known.walk(60), known.tie(1.0)):
        first, second = probe.answer(one)[1], probe.ask(one.compile())
        for name in ("value", "occupation", "policy"):
            a, b = getattr(first, name), getattr(second, name)
            if (a is None) != (b is None) or (a is not None and a.tobytes() != b.tobytes()):
                raise Broken(f"{name} differs from one time to the next on the LP {one.name}")


def solution(probe: Probe) -> None:
    """Every solve of every check returned a well-formed Solution."""
    if probe.malformed:
        first, more = probe.malformed[0], len(probe.malformed) - 1
        raise Broken(first + (f" (and {more} more like that)" if more else ""))


def _importable(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _bytes(lp: StabilizationLP, first: np.ndarray) -> dict[str, bytes]:
    arrays = {field.name: getattr(lp, field.name) for field in fields(lp)}
    arrays |= {f"rows.{field.name}": getattr(lp.rows, field.name) for field in fields(lp.rows)}
    arrays |= {"rows.shares.value": lp.rows.shares.value, "cell": lp.cell, "start": first}
    return {name: a.tobytes() for name, a in arrays.items() if isinstance(a, np.ndarray)}

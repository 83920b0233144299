"""The wall between a backend and everything that is proved.

A backend, ours or a third party's, is asked here and nowhere else. What it returns is read once and
copied into plain arrays of our own, what it raises becomes a failure, and what it is given is its
own copy of the model. Beyond this module a solution is data, right or wrong.
"""

import copy
import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl import backends
from lmdsl.backends import Backend, Options, Solution, Stop
from lmdsl.backends.policy_iteration import Iterated
from lmdsl.backends.scaled import failure
from lmdsl.common.records import freeze
from lmdsl.common.types import Floats, Indices, Policy
from lmdsl.errors import BadInput, MissingDependency, plain_text
from lmdsl.machine import quiet
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.surroundings import restore_rounding
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.policies import presolve
from lmdsl.optimize.policies.iteration import Iteration

# Number of iterations above which it is no count, and no number that JSON keeps.
MOST_ITERATIONS = 2**53


def ask(
    lp: StabilizationLP, backend: Backend, options: Options
) -> tuple[Solution, Iteration | None, str]:
    """Ask a backend; whatever it raises, returns or prints, a well-formed solution comes out.

    Returns it, the last step of policy iteration where that was asked, and what was printed. The
    arrays are new, of class ndarray, in C order, finite and of the right length; ``policy`` names a
    column of each cell's own; parts that are not so are None. BadInput: the backend refuses the
    options, or a package is missing.
    """
    if options.max_iterations is not None:  # solvers take 32-bit integers
        options = replace(options, max_iterations=min(int(options.max_iterations), 2**31 - 1))
    if backend.capabilities.silent and backends.ours(backend):
        return *_ask(lp, backend, options), ""
    progress = options.progress and quiet.ours(options.progress)
    with quiet.foreign() as printed:
        return *_ask(lp, backend, replace(options, progress=progress)), printed()


def _ask(
    lp: StabilizationLP, backend: Backend, options: Options
) -> tuple[Solution, Iteration | None]:
    asked, kept = lp, None
    own, process = backends.ours(backend), os.getpid()
    try:
        with np.errstate(all="ignore"):  # NumPy's settings are restored
            if backend.capabilities.elimination and options.start is not None:
                kept, options = _without_suboptimal(lp, options)
                asked = lp if len(kept) == lp.K else lp.part(kept, np.arange(lp.n))
            try:
                found = backend.solve(*((asked, options) if own else _copies(asked, options)))
            finally:
                if os.getpid() != process:  # a fork that it left running: not to answer as well
                    os._exit(1)
                restore_rounding("the backend")
            solution = _plain(asked, found)
            iteration = found.iteration if own and isinstance(found, Iterated) else None
    except BadInput as refusal:
        if own:
            raise
        kind = MissingDependency if isinstance(refusal, MissingDependency) else BadInput
        raise kind(plain_text(refusal, 500)) from None
    except BaseException as error:  # solvers written in Rust panic outside Exception
        return failure(error), None
    return _over(lp, solution, kept), iteration


def _copies(lp: StabilizationLP, options: Options) -> tuple[StabilizationLP, Options]:
    """Return copies: what a backend does to them, then or later, happens to nobody else."""
    function = getattr(lp.problem.system, "next", None)  # of Python: the user's, not to be copied
    own = copy.deepcopy(lp, {id(function): function} if callable(function) else {})
    start, proof = copy.copy(options.start), copy.copy(options.proof)
    freeze(*(array for array in (start, proof) if array is not None))
    return own, replace(options, start=start, proof=proof)


def _without_suboptimal(lp: StabilizationLP, options: Options) -> tuple[Indices, Options]:
    """Return the columns worth solving for, and the options for a model of these alone."""
    deadline, start = Deadline(options.time_limit), options.start
    assert start is not None
    kept = presolve.survivors(lp, start, options.proof, deadline)
    return kept, replace(options, time_limit=deadline.left, start=np.searchsorted(kept, start))


def _plain(lp: StabilizationLP, found: Any) -> Solution:
    """Return what a backend returned, each part read once, in plain types; may raise anything."""
    if not isinstance(found, Solution):
        return Solution(Stop.FAILED, "the backend returned no Solution")
    stop, word, iterations = found.stop, found.word, found.iterations
    if type(stop) is not Stop:
        return Solution(Stop.FAILED, "the backend returned no Solution")
    return Solution(
        stop,
        plain_text(word),
        _numbers(found.value, lp.n),
        _numbers(found.occupation, lp.K),
        _columns(lp, found.policy),
        _count(iterations),
    )


def _over(lp: StabilizationLP, solution: Solution, kept: Indices | None) -> Solution:
    """Return a solution over all columns, where only some were asked for."""
    if kept is None:
        return solution
    policy, occupation = solution.policy, solution.occupation
    if occupation is not None:
        spread = np.zeros(lp.K)
        spread[kept] = occupation
        occupation = spread
    return replace(solution, policy=None if policy is None else kept[policy], occupation=occupation)


def _own(values: Any, count: int, kinds: str) -> NDArray[Any] | None:
    """Return a copy of real numbers in their own type, None where they are no such vector."""
    if values is None or (isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values)):
        return None
    array = np.asarray(values)
    if array.shape != (count,) or array.dtype.kind not in kinds:
        return None
    return np.array(array, order="C", subok=False)


def _numbers(values: Any, count: int) -> Floats | None:
    array = _own(values, count, "fiu")
    if array is None:
        return None
    array = array.astype(np.float64)
    return array if np.isfinite(array).all() else None


def _columns(lp: StabilizationLP, policy: Any) -> Policy | None:
    array = _own(policy, lp.n, "iu")
    if array is None:
        return None
    owned = (array >= lp.pair_pointer[:-1]) & (array < lp.pair_pointer[1:])
    return array.astype(np.int64) if owned.all() else None


def _count(value: Any) -> int | None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        return None
    number = value.__index__()
    return number if 0 <= number <= MOST_ITERATIONS else None

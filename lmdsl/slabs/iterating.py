"""Policy iteration over ranks: passes by all, evaluation by rank 0 or by all.

While a policy is improved its values never rise: where they do, ranks saw wrong values.
"""

from collections.abc import Callable

import numpy as np

from lmdsl.common.types import Floats, Policy, TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.optimize.policies.iteration import FEW, TIE
from lmdsl.optimize.policies.screening import Screen, _least_ratio
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs.chains.evaluating import Evaluator
from lmdsl.slabs.chains.first import First

Keep = Callable[[Policy, Floats], None]
RISE, TINY = 1e-9, 1e-300  # relative rise of a value up to which it is rounding


def iterated(
    first: First, by: Evaluator, policy: Policy, V: Floats, time_up: TimeUp,
    keep: Keep | None = None,
) -> tuple[Policy, Floats, Screen, int]:  # fmt: skip
    """Improve a policy until no control is better; return the last, its value, and the steps.

    As :func:`lmdsl.optimize.policies.iteration.iterate`: while policies change a lower V >= T_u V
    will do; only one evaluated to the end is returned. ``keep`` is told every policy and its V.
    """
    lp, ranks = first.lp, first.mesh.ranks
    screen, steps, unevaluated = Screen(lp), 0, False
    last: tuple[Policy, Floats] | None = None
    while True:
        done = screen.improve(V, policy, TIE)
        changed = sum(ranks.collect(done.changed))
        out = time_up()
        if last is not None and (not changed or out):
            return *last, screen, steps
        steps += changed > 0
        # As one process: passes read less than an evaluation where few controls change.
        few = steps == 1 or changed * FEW < first.mesh.division.cells
        unevaluated = changed > 0 and few and not unevaluated and not out
        before, last = last, None
        try:
            if unevaluated:
                lower, exact = done.value, False
            elif changed and not out:
                lower, exact = by.lower(done.policy, done.value, screen)
            else:
                lower, exact = by.value(done.policy, done.value, screen), True
        except Stopped:  # on all ranks
            return *(before or (policy, V)), screen, steps
        if exact:
            _require_fallen(first, V, lower)
            if before is not None and not ranks.any(bool((lower < before[1]).any())):
                return *before, screen, steps  # rounding made a change look better than it is
            last = done.policy, lower
        ratio = min(ranks.collect(_least_ratio(V, np.minimum(lower, V))))
        screen.follow(np.ones(1), np.array([ratio]))
        policy, V = done.policy, lower
        if keep:
            keep(policy, V)


def _require_fallen(first: First, before: Floats, after: Floats) -> None:
    """Refuse a value that rose: where V >= T_u V that of u is below V, so that a halo was wrong."""
    rose = np.flatnonzero(after > before * (1 + RISE) + TINY)
    if first.mesh.ranks.any(len(rose) > 0):
        raise RankError("a policy that looked better is worse: ranks saw wrong values of others")

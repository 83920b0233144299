"""The checks: each takes a :class:`Probe` and returns, or says what is Broken or Unjudged.

The docstring of a check is what holds when it passes.
"""

from collections.abc import Callable

from lmdsl.testing import answers, conduct
from lmdsl.testing.probe import Probe

# All checks, in order; ``solution`` is last, for it speaks of the solves of all others.
CHECKS: dict[str, Callable[[Probe], None]] = {
    "requires": conduct.requires,
    "algorithms": conduct.algorithms,
    "value": answers.value,
    "occupation": answers.occupation,
    "policy": answers.policy,
    "vertex": answers.vertex,
    "dual sign": answers.dual_sign,
    "exact tie": answers.exact_tie,
    "degenerate": answers.degenerate,
    "trapped": answers.trapped,
    "gamma under": answers.gamma_under,
    "gamma over": answers.gamma_over,
    "rays": answers.rays,
    "zero cost": answers.zero_cost,
    "zeros in the cost": answers.zeros,
    "scale": answers.scale,
    "start": conduct.start,
    "tolerance": conduct.tolerance,
    "time limit": conduct.time_limit,
    "iteration limit": conduct.iteration_limit,
    "options": conduct.options,
    "inputs": conduct.inputs,
    "deterministic": conduct.deterministic,
    "solution": conduct.solution,
}

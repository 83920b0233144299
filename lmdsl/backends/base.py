"""What a backend is: one function ``solve(lp, options) -> Solution`` and one record of abilities.

Sign conventions. The LP is min G'theta, (E - gamma P)'theta = m, theta >= 0 with m the weight
``lp.solve_weight``; ``Solution.value`` is V, the multiplier of the equalities with the sign that
makes V the cost-to-go: d(optimal cost)/dm = V >= 0 wherever G >= 0.

A status is the backend's claim, never an answer: the policy that comes out of it is polished and
certified by code that does not know the backend.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any

from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Indices

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP


class Stop(Enum):
    """Why a backend stopped; the value is what to tell the user."""

    OPTIMAL = "the backend claims an optimal solution"
    INACCURATE = "the backend claims a solution of reduced accuracy"
    INFEASIBLE = "the backend claims that no policy has finite cost at this gamma"
    UNBOUNDED = "the backend claims an unbounded problem"
    TIME_LIMIT = "the time limit was reached; raise it or use another backend"
    ITERATION_LIMIT = "the iteration limit was reached; raise it or use another backend"
    INTERRUPTED = "the solve was interrupted"
    FAILED = "the backend failed; use another backend or algorithm"

    @property
    def limit(self) -> bool:
        """True when the user's limit, not the backend, ended the work."""
        return self in (Stop.TIME_LIMIT, Stop.ITERATION_LIMIT, Stop.INTERRUPTED)

    @property
    def success(self) -> bool:
        """True when the backend claims a solution."""
        return self in (Stop.OPTIMAL, Stop.INACCURATE)


@dataclass(frozen=True, eq=False)
class Capabilities(Frozen):
    """What a backend can do.

    Attributes
    ----------
    algorithms
        Values of ``Options.algorithm``, the default first.
    extras
        Algorithms that need one more distribution, by name; shown as not installed without it.
    vertex
        Its occupation measure is a vertex: at most one positive entry per cell.
    rays
        It can return a certificate of infeasibility.
    warm_start
        It makes use of ``Options.start``.
    elimination
        It is given only the columns that may belong to an optimal policy (presolve.py).
    tolerance, time_limit, iteration_limit
        It respects these options.
    silent
        It prints nothing; the output of any other is kept from the user (quiet.py).
    """

    algorithms: tuple[str, ...] = ()
    vertex: bool = False
    rays: bool = False
    warm_start: bool = False
    elimination: bool = False
    tolerance: bool = True
    time_limit: bool = True
    iteration_limit: bool = True
    silent: bool = False
    extras: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Options:
    """What the user asks of a backend.

    Attributes
    ----------
    tolerance
        The gap that will count as verified; None for the backend's own accuracy.
    time_limit
        Seconds, None for no limit.
    max_iterations
        Iterations in the backend's own sense, None for its default.
    algorithm
        One of ``Capabilities.algorithms``, None for the first.
    start
        A g-stabilizing policy, shape (n,), a column per cell.
    proof
        w > 0 with w > g P_u w for that policy, g = max(gamma, 1), shape (n,); None where unknown.
    value
        The cost of that policy, shape (n,); None where unknown.
    progress
        Called with (stage, fraction done or -1).
    keep
        Called with a g-stabilizing policy and a V >= T_u V after every step, for checkpoints.
    """

    tolerance: float | None = None
    time_limit: float | None = None
    max_iterations: int | None = None
    algorithm: str | None = None
    start: Indices | None = None
    proof: Floats | None = None
    value: Floats | None = None
    progress: Callable[[str, float], None] | None = None
    keep: Callable[[Indices, Floats], None] | None = None


@dataclass(frozen=True, eq=False)
class Solution:
    """What a backend returns; every part but ``stop`` and ``word`` may be missing.

    Attributes
    ----------
    stop
        Why it stopped.
    word
        The solver's own status word.
    value
        V, shape (n,).
    occupation
        theta, shape (K,).
    policy
        A policy, shape (n,): a column per cell.
    iterations
        Iterations in the backend's own sense.
    details
        Anything else worth showing.
    """

    stop: Stop
    word: str
    value: Floats | None = None
    occupation: Floats | None = None
    policy: Indices | None = None
    iterations: int | None = None
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Backend:
    """A named backend.

    Attributes
    ----------
    name
        The name by which it is asked for.
    solve
        The function.
    capabilities
        The record.
    requires
        Import names of the packages it needs, checked without importing them.
    """

    name: str
    solve: Callable[[StabilizationLP, Options], Solution]
    capabilities: Capabilities = field(default_factory=Capabilities)
    requires: tuple[str, ...] = ()

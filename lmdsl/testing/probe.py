"""Asks a backend and judges what comes back; one :class:`Probe` per backend and algorithm."""

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.backends import Backend, Options, Solution, Stop
from lmdsl.backends.scaled import failure
from lmdsl.common.types import Floats
from lmdsl.errors import LmdslError, MissingDependency
from lmdsl.machine import quiet
from lmdsl.model.lp import StabilizationLP
from lmdsl.testing.known import Known

ACCURACY = 1e-5  # largest relative error of an answer that was asked for without a tolerance

REDUCED_ACCURACY = 1e-3  # the same where the backend says INACCURATE


class Broken(Exception):
    """The check fails; the message says why."""


class Unjudged(Exception):
    """The check does not apply, or another one already says what is wrong."""


@dataclass
class Probe:
    """A backend with one of its algorithms."""

    # backend, algorithm: who is asked
    backend: Backend
    algorithm: str | None
    # what was wrong with the form of its answers, whichever check asked
    malformed: list[str] = field(default_factory=list)
    # its solutions without options, by the name of the LP
    answers: dict[str, Solution] = field(default_factory=dict)

    def needs(self, capability: str) -> None:
        """Leave a check unjudged that asks for what the record does not promise."""
        if not getattr(self.backend.capabilities, capability):
            raise Unjudged(f"the record says {capability}=False")

    def ask(self, lp: StabilizationLP, **options: Any) -> Solution:
        """Return a well-formed solution.

        Unjudged: there is none; the check ``solution`` will say so. MissingDependency: the
        algorithm is not installed.
        """
        try:
            found: Solution = self.raw(lp, **options)
        except MissingDependency:
            raise
        except LmdslError as error:
            fault: str | None = f"it refuses a proper LP: {error}"
        else:
            fault = misshapen(lp, found)
        if fault is None:
            return found
        self.malformed.append(fault)
        raise Unjudged("there is no well-formed solution to judge")

    def raw(self, lp: StabilizationLP, **options: Any) -> Any:
        """Return whatever the backend returns; exceptions not of lmdsl are noted as malformed."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with quiet.foreign():
                    return self.backend.solve(lp, Options(algorithm=self.algorithm, **options))
        except LmdslError:
            raise
        except BaseException as error:  # solvers written in Rust panic outside Exception
            self.malformed.append(f"it raises {failure(error).word}")
            raise Unjudged("the backend raised an exception") from error

    def solved(self, known: Known, **options: Any) -> tuple[StabilizationLP, Solution]:
        """Return the LP and its solution; it is Broken unless success is claimed."""
        lp, found = self.answer(known, **options)
        if not found.stop.success:
            raise Broken(f"it stops with {found.stop.name} ({found.word}) on the LP {known.name}")
        return lp, found

    def claimed(self, known: Known) -> tuple[StabilizationLP, Solution]:
        """Return the same for checks that come after ``value``, which judges the status."""
        lp, found = self.answer(known)
        if not found.stop.success:
            raise Unjudged(f"no solution is claimed on the LP {known.name}")
        return lp, found

    def answer(self, known: Known, **options: Any) -> tuple[StabilizationLP, Solution]:
        """Return an LP that the backend never saw, and the solution of the one it was given.

        Without options it is asked once for each LP.
        """
        if options:
            return known.own, self.ask(known.compile(), **options)
        if known.name not in self.answers:
            self.answers[known.name] = self.ask(known.compile())
        return known.own, self.answers[known.name]

    def right(self, known: Known, **options: Any) -> None:
        """It is Broken unless a solution is claimed and has the value derived by hand."""
        lp, found = self.solved(known, **options)
        judge(known, lp, found)


def misshapen(lp: StabilizationLP, found: Any) -> str | None:
    """Return what is wrong with the form of a solution, None where it is well formed."""
    if not isinstance(found, Solution):
        return f"it returns a {type(found).__name__}, not a Solution"
    if not isinstance(found.stop, Stop):
        return f"stop is a {type(found.stop).__name__}, not a Stop"
    if not isinstance(found.word, str):
        return f"word is a {type(found.word).__name__}, not a text"
    if not isinstance(found.iterations, int | np.integer | None):
        return f"iterations is a {type(found.iterations).__name__}, not a whole number"
    parts = (("value", lp.n, "f"), ("occupation", lp.K, "f"), ("policy", lp.n, "iu"))
    given = 0
    for name, count, kinds in parts:
        array = getattr(found, name)
        if array is None:
            continue
        given += 1
        if isinstance(array, np.ndarray) and type(array) is not np.ndarray:
            return f"{name} is a {type(array).__name__}, not a plain array"
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            return f"{name} is no array of the right kind of numbers"
        if array.shape != (count,):
            return f"{name} has shape {array.shape} instead of ({count},)"
        if found.stop.success and not np.isfinite(array).all():
            return f"{name} is not finite"
    if found.stop.success and not given:
        return f"{found.stop.name} comes without value, occupation and policy"
    return None


def judge(
    known: Known, lp: StabilizationLP, found: Solution, accuracy: float | None = None
) -> None:
    """It is Broken unless a solution has the value derived by hand, up to the sign of V.

    The sign has a check of its own. Judged is V, else the cost of the policy, else c'theta.
    """
    if accuracy is None:
        accuracy = ACCURACY if found.stop is Stop.OPTIMAL else REDUCED_ACCURACY
    top = float(known.value.max()) or 1.0
    if found.value is not None:
        error = float(np.abs(np.abs(found.value) - known.value).max()) / top
    elif found.policy is not None and owned(lp, found.policy):
        error = float(np.abs(cost_to_go(lp, found.policy) - known.value).max()) / top
    elif found.occupation is not None:
        error = abs(float(lp.c @ found.occupation) - known.optimum(lp)) / top
    else:
        raise Unjudged("there is nothing to judge")
    if not error <= accuracy:
        raise Broken(f"the value is off by {error:.1e} relative on the LP {known.name}")


def owned(lp: StabilizationLP, policy: NDArray[Any]) -> bool:
    """Return whether a policy, shape (n,), names one column of each cell's own."""
    return bool(((policy >= lp.pair_pointer[:-1]) & (policy < lp.pair_pointer[1:])).all())


def cost_to_go(lp: StabilizationLP, policy: NDArray[Any]) -> Floats:
    """Return V = G_u + gamma P_u V of a policy by dense algebra, infinite where it has none."""
    M = lp.gamma * lp.P.toarray()[policy]
    if max(abs(np.linalg.eigvals(M))) >= 1:
        return np.full(lp.n, np.inf)
    V: Floats = np.linalg.solve(np.eye(lp.n) - M, lp.cost[policy])
    return V

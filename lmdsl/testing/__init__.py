"""The contract suite for backends: whether a backend, yours or ours, does what it promises.

:func:`check_backend` asks it for small LPs whose answers are derived by hand and judges what it
claims against what it returns. The record of capabilities decides which checks apply.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from lmdsl import backends
from lmdsl.backends import Backend
from lmdsl.errors import BadInput, MissingDependency, shown
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.testing.checks import CHECKS
from lmdsl.testing.probe import Broken, Probe, Unjudged

__all__ = ["Check", "ContractFailure", "Report", "check_backend"]


PASSED, FAILED, SKIPPED = "passed", "failed", "skipped"


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes
    ----------
    name
        The check.
    algorithm
        The algorithm it ran with, empty for the backend's default.
    outcome
        ``"passed"``, ``"failed"`` or ``"skipped"``.
    reason
        What was found, in one sentence.
    """

    name: str
    algorithm: str
    outcome: str
    reason: str

    def __str__(self) -> str:
        where = f"{self.algorithm}, " if self.algorithm else ""
        return f"{self.outcome:8}{where}{self.name}: {self.reason}"


@dataclass(frozen=True)
class Report:
    """The outcomes of all checks of a backend.

    Attributes
    ----------
    backend
        Its name.
    checks
        One :class:`Check` per check and algorithm, in order.
    """

    backend: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """True when no check failed and at least one passed."""
        return not self.failed and any(check.outcome == PASSED for check in self.checks)

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that failed."""
        return tuple(check for check in self.checks if check.outcome == FAILED)

    @property
    def skipped(self) -> tuple[Check, ...]:
        """The checks that did not apply."""
        return tuple(check for check in self.checks if check.outcome == SKIPPED)

    def __iter__(self) -> Iterator[Check]:
        return iter(self.checks)

    def __str__(self) -> str:
        return "\n".join(str(check) for check in self.checks)


class ContractFailure(AssertionError):
    """A backend breaks the contract; the message lists every failed check.

    Parameters
    ----------
    report
        The whole report, kept as an attribute.
    """

    def __init__(self, report: Report) -> None:
        self.report = report
        lines = [f"the backend {report.backend} breaks the contract", *map(str, report.failed)]
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.report,)


@own_arithmetic
def check_backend(
    backend: str | Backend,
    *,
    algorithms: Sequence[str] | None = None,
    raise_on_failure: bool = True,
) -> Report:
    """Run the contract suite on a backend.

    Parameters
    ----------
    backend
        A name, ``"name:algorithm"`` or a Backend.
    algorithms
        The algorithms to run with; by default the one named, else all that the record lists, else
        the backend's own default.
    raise_on_failure
        Raise if a check fails.

    Returns
    -------
    Report
        The outcome of every check for every algorithm. Checks that the record rules out, and
        algorithms that are not installed, are skipped.

    Raises
    ------
    ContractFailure
        A check failed: an AssertionError that lists every failure.
    BadInput
        There is no such backend or algorithm, or (MissingDependency) its package is missing.
    """
    if isinstance(algorithms, str):
        raise BadInput(f"{shown(algorithms)} must be a sequence of names", "algorithms")
    chosen, named = backends.resolve(backend)
    listed = chosen.capabilities.algorithms
    wanted: Sequence[str | None]
    if algorithms is not None:
        wanted = tuple(algorithms)
        for algorithm in wanted:
            if listed and algorithm not in listed:
                raise BadInput(
                    f"{shown(algorithm)} is not one of {', '.join(listed)}", "algorithms"
                )
    else:
        wanted = (named,) if named else listed or (None,)
    found = [check for algorithm in wanted for check in _run(chosen, algorithm)]
    report = Report(chosen.name, tuple(found))
    if raise_on_failure and report.failed:
        raise ContractFailure(report)
    return report


def _run(backend: Backend, algorithm: str | None) -> list[Check]:
    probe, label = Probe(backend, algorithm), algorithm or ""
    found = []
    for name, check in CHECKS.items():
        outcome, reason = PASSED, (check.__doc__ or "").strip()
        try:
            check(probe)
        except Broken as fault:
            outcome, reason = FAILED, f"{fault}."
        except Unjudged as why:
            outcome, reason = SKIPPED, f"{why}."
        except MissingDependency as absent:
            return [Check("available", label, SKIPPED, f"{absent.message}.")]
        found.append(Check(name, label, outcome, reason))
    return found

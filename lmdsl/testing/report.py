"""What a run of the contract suite says."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

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

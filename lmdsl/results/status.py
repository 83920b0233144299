"""The words for how a solve ended, and why a problem cannot be stabilized."""

from enum import StrEnum


class _Word(StrEnum):
    def __repr__(self) -> str:
        return repr(self.value)


class Status(_Word):
    """How a solve ended, in the order of the exit statuses, from 0."""

    VERIFIED = "verified"
    UNVERIFIED = "unverified"
    BAD_INPUT = "bad_input"
    NOT_STABILIZABLE = "not_stabilizable"
    SOLVER_FAILED = "solver_failed"

    @property
    def exit_status(self) -> int:
        """Exit status of the command line."""
        return [*Status].index(self)


class Cause(_Word):
    """Why a problem cannot be stabilized."""

    EMPTY = "empty"
    MEASURE = "measure"
    GAMMA = "gamma"
    REQUIRE_ALL = "require_all"
    HOLD = "hold"

"""Who solves the LP: the registry, the wall around what backends say, and one file for each."""

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.backends.registry import BUILT_IN as BUILT_IN
from lmdsl.backends.registry import DEFAULT as DEFAULT
from lmdsl.backends.registry import get, installed, missing, names, resolve
from lmdsl.backends.registry import ours as ours

__all__ = [
    "Backend", "Capabilities", "Options", "Solution", "Stop", "get", "installed", "missing",
    "names", "resolve",
]  # fmt: skip

"""Optimal stabilization with Lyapunov measures: from a declared system to a verified controller.

The public names; each is imported when first used, so ``import lmdsl`` loads no solver.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lmdsl import forking as forking

if TYPE_CHECKING:
    from lmdsl import backends as backends
    from lmdsl import exports as exports
    from lmdsl import plotting as plotting
    from lmdsl import systems as systems
    from lmdsl import testing as testing
    from lmdsl.certificate import Certificate as Certificate
    from lmdsl.comparison import Comparison as Comparison
    from lmdsl.comparison import compare as compare
    from lmdsl.controller import Controller as Controller
    from lmdsl.controller import Simulation as Simulation
    from lmdsl.deadline import TimeLimitReached as TimeLimitReached
    from lmdsl.errors import BadInput as BadInput
    from lmdsl.errors import LmdslError as LmdslError
    from lmdsl.explanation import explain as explain
    from lmdsl.gamma import GammaBar as GammaBar
    from lmdsl.gamma import gamma_max as gamma_max
    from lmdsl.graph import CellStatus as CellStatus
    from lmdsl.lp import StabilizationLP as StabilizationLP
    from lmdsl.lp import compile as compile
    from lmdsl.problem import Problem as Problem
    from lmdsl.problem import load as load
    from lmdsl.result import Result as Result
    from lmdsl.stabilize import solve as solve
    from lmdsl.verification import Verification as Verification
    from lmdsl.verification import verify as verify

__version__ = "0.1.0"

_HOME = {
    "BadInput": "errors",
    "CellStatus": "graph",
    "Certificate": "certificate",
    "Comparison": "comparison",
    "Controller": "controller",
    "GammaBar": "gamma",
    "LmdslError": "errors",
    "Problem": "problem",
    "Result": "result",
    "Simulation": "controller",
    "StabilizationLP": "lp",
    "TimeLimitReached": "deadline",
    "Verification": "verification",
    "compare": "comparison",
    "compile": "lp",
    "explain": "explanation",
    "gamma_max": "gamma",
    "load": "problem",
    "solve": "stabilize",
    "verify": "verification",
}
_MODULES = ("backends", "exports", "plotting", "systems", "testing")

__all__ = ["__version__", *_HOME, *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        with forking.whole:
            value = getattr(import_module(f"lmdsl.{_HOME[name]}"), name)
    elif name in _MODULES:
        with forking.whole:
            value = import_module(f"lmdsl.{name}")
    else:
        raise AttributeError(f"module 'lmdsl' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""Optimal stabilization with Lyapunov measures: from a declared system to a verified controller.

The public names; each is imported when first used, so ``import lmdsl`` loads no solver.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lmdsl.machine import forking as forking

if TYPE_CHECKING:
    from lmdsl import backends as backends
    from lmdsl import distributed as distributed
    from lmdsl import interop as interop
    from lmdsl import plotting as plotting
    from lmdsl import systems as systems
    from lmdsl import testing as testing
    from lmdsl.advice.checking import check as check
    from lmdsl.advice.report import CheckReport as CheckReport
    from lmdsl.advice.report import Finding as Finding
    from lmdsl.advice.studies.record import Study as Study
    from lmdsl.advice.studies.running import study as study
    from lmdsl.advice.suggesting.report import Suggestion as Suggestion
    from lmdsl.advice.suggesting.search import suggest as suggest
    from lmdsl.certificate.claims import Certificate as Certificate
    from lmdsl.control.controller import Controller as Controller
    from lmdsl.control.simulation import Simulation as Simulation
    from lmdsl.data.from_data import from_data as from_data
    from lmdsl.data.tables import read_data as read_data
    from lmdsl.errors import BadInput as BadInput
    from lmdsl.errors import LmdslError as LmdslError
    from lmdsl.explanation.causes import Explanation as Explanation
    from lmdsl.explanation.causes import explain as explain
    from lmdsl.explanation.lost_mass import PhaseOne as PhaseOne
    from lmdsl.machine.deadline import TimeLimitReached as TimeLimitReached
    from lmdsl.model.grid.boxes import Area as Area
    from lmdsl.model.grid.boxes import Region as Region
    from lmdsl.model.lp import StabilizationLP as StabilizationLP
    from lmdsl.model.lp import compile as compile
    from lmdsl.model.stabilizable_set import CellStatus as CellStatus
    from lmdsl.optimize.feasibility.gamma_bar import GammaBar as GammaBar
    from lmdsl.optimize.feasibility.gamma_bar import gamma_max as gamma_max
    from lmdsl.problem.from_matrices import from_matrices as from_matrices
    from lmdsl.problem.problem import Problem as Problem
    from lmdsl.problem.problem import load as load
    from lmdsl.results import exports as exports
    from lmdsl.results.comparison import Comparison as Comparison
    from lmdsl.results.comparison import compare as compare
    from lmdsl.results.result import Result as Result
    from lmdsl.results.solving import solve as solve
    from lmdsl.results.verification import Verification as Verification
    from lmdsl.results.verification import verify as verify

__version__ = "0.1.0"

_HOME = {
    "Area": "model.grid.boxes",
    "BadInput": "errors",
    "CellStatus": "model.stabilizable_set",
    "Certificate": "certificate.claims",
    "CheckReport": "advice.report",
    "Comparison": "results.comparison",
    "Controller": "control.controller",
    "Explanation": "explanation.causes",
    "Finding": "advice.report",
    "GammaBar": "optimize.feasibility.gamma_bar",
    "LmdslError": "errors",
    "PhaseOne": "explanation.lost_mass",
    "Problem": "problem.problem",
    "Region": "model.grid.boxes",
    "Result": "results.result",
    "Simulation": "control.simulation",
    "StabilizationLP": "model.lp",
    "Study": "advice.studies.record",
    "Suggestion": "advice.suggesting.report",
    "TimeLimitReached": "machine.deadline",
    "Verification": "results.verification",
    "check": "advice.checking",
    "compare": "results.comparison",
    "compile": "model.lp",
    "explain": "explanation.causes",
    "from_data": "data.from_data",
    "from_matrices": "problem.from_matrices",
    "gamma_max": "optimize.feasibility.gamma_bar",
    "load": "problem.problem",
    "read_data": "data.tables",
    "solve": "results.solving",
    "study": "advice.studies.running",
    "suggest": "advice.suggesting.search",
    "verify": "results.verification",
}
_OPEN = ("backends", "distributed", "interop", "plotting", "systems", "testing")
_PACKAGES = {name: name for name in _OPEN}
_PACKAGES["exports"] = "results.exports"

__all__ = ["__version__", *_HOME, *_PACKAGES]


def __getattr__(name: str) -> Any:
    home = _HOME.get(name) or _PACKAGES.get(name)
    if home is None:
        raise AttributeError(f"module 'lmdsl' has no attribute {name!r}")
    with forking.whole:
        module = import_module(f"lmdsl.{home}")
    value = getattr(module, name) if name in _HOME else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""The walls of the house: who may import whom, what is public, what importing costs."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import lmdsl as lm

PACKAGE = Path(lm.__file__).parent

# Data flows one way: a module imports only from modules on an earlier line.
ORDER = """
errors frozen forking
surroundings inputs
kernels
files arrays quiet
folder
saving
formulas
intervals
jets
program recording
faults
declared
systems.base
systems.*
systems
declarations
problem
memory threads directions deadline axis
sampling
apart linprog
sweeps
peeling merging leaps
linear
partition rows
boxes lines
regions sampler riccati
local
local_check
transitions
graph
lp
bellman sums
screening rational
bounds
policy
growth
feasibility elimination
gamma
backends.base
backends.scaled
backends
backends.*
asking certificate
witness
exact
controller
result
archive
stabilize
facts
phase_one hints
explanation
stored
comparison verification
exports.*
exports
drawing drawing.view
drawing.*
plotting
testing.known testing.report
testing.probe
testing.checks
testing
cli.streams
cli.streams
cli.output
cli.*
cli
__main__
"""

PUBLIC = [
    "BadInput", "CellStatus", "Certificate", "Comparison", "Controller", "GammaBar",
    "LmdslError", "Problem", "Result", "Simulation", "StabilizationLP", "TimeLimitReached",
    "Verification", "__version__", "backends", "compare", "compile", "explain", "exports",
    "gamma_max", "load", "plotting", "solve", "systems", "testing", "verify",
]  # fmt: skip

# Imports inside functions against the order, each with its reason.
DEFERRED = {
    ("result", "archive"),  # Result.save and Result.load are conveniences of the archive
    ("backends", "backends.*"),  # the registry loads a backend when it is asked for
}


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        yield ".".join(p for p in parts if p != "__init__") or "__init__", path


def rank(name):
    for i, line in enumerate(ORDER.split("\n")):
        names = line.split()
        if name in names or (
            "." in name and f"{name.split('.')[0]}.*" in names and name not in ORDER.split()
        ):
            return i
    raise AssertionError(f"{name} has no place in the order; give it one")


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "absolute imports only"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                is_module = (PACKAGE.parent / (inner.replace(".", "/") + ".py")).exists() or (
                    PACKAGE.parent / inner.replace(".", "/") / "__init__.py"
                ).exists()
                yield inner if is_module else str(node.module)


@pytest.mark.parametrize(("name", "path"), [m for m in modules() if m[0] != "__init__"])
def test_imports_follow_the_order(name, path):
    for imported in imports(path):
        if imported == "lmdsl" or not imported.startswith("lmdsl."):
            continue
        other = imported.removeprefix("lmdsl.")
        if (name, other) in DEFERRED or (name, f"{other.split('.')[0]}.*") in DEFERRED:
            continue
        assert rank(other) < rank(name), f"{name} imports {other}"


def test_solver_libraries_are_imported_in_their_own_file_only():
    for name, path in modules():
        for imported in imports(path):
            library = imported.split(".")[0]
            if library in ("highspy", "clarabel", "cvxpy", "casadi"):
                assert name.startswith("backends."), f"{name} imports {library}"


def test_public_names_are_pinned():
    assert sorted(lm.__all__) == sorted(PUBLIC)
    for name in PUBLIC:
        assert getattr(lm, name) is not None
    with pytest.raises(AttributeError):
        lm.nonsense  # noqa: B018


def test_importing_is_light():
    code = "import sys, lmdsl; print(sorted(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("numpy", "scipy", "numba", "pydantic", "highspy", "clarabel", "cvxpy",
                  "matplotlib"):  # fmt: skip
        assert f"'{heavy}'" not in done.stdout


def test_solving_loads_no_other_solver():
    code = (
        "import sys, lmdsl as lm; lm.solve(lm.Problem.model_validate("
        "lm.systems.NAMED['double_integrator'].problem).replaced(gamma=1.0));"
        "print(sorted(m for m in sys.modules if '.' not in m))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("highspy", "clarabel", "cvxpy", "matplotlib"):
        assert f"'{heavy}'" not in done.stdout


def documented():
    for name in PUBLIC:
        item = getattr(lm, name)
        if inspect.isclass(item) or inspect.isfunction(item):
            yield name, item
            if inspect.isclass(item):
                for method, function in vars(item).items():
                    if inspect.isfunction(function) and not method.startswith("_"):
                        yield f"{name}.{method}", function


@pytest.mark.parametrize(("name", "item"), list(documented()))
def test_public_parameters_are_documented(name, item):
    text = inspect.getdoc(item) or ""
    assert text, f"{name} has no docstring"
    if not inspect.isfunction(item) or "." in name:
        return
    for parameter in inspect.signature(item).parameters:
        assert parameter in text, f"{name} does not document {parameter}"


def test_the_checker_of_certificates_stands_alone():
    script = PACKAGE.parent / "tools/check_certificate.py"
    assert len(script.read_text().splitlines()) < 200
    for imported in imports(script):
        assert imported.split(".")[0] in sys.stdlib_module_names


def test_no_file_is_too_long():
    long = {name: n for name, path in modules() if (n := len(path.read_text().splitlines())) > 500}
    assert not long

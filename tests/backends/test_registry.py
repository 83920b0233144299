"""Statuses of foreign solvers, and the registry of backends."""

import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from lmdsl import backends
from lmdsl.backends import BUILT_IN, Stop, get, names, registry
from lmdsl.backends import clarabel as clarabel_backend
from lmdsl.backends import cvxpy as cvxpy_backend
from lmdsl.backends import highs as highs_backend
from lmdsl.backends import ipopt as ipopt_backend
from lmdsl.cli import main

# Statuses -------------------------------------------------------------------------------------


def highs_statuses():
    import highspy

    return set(highspy.HighsModelStatus.__members__)


def clarabel_statuses():
    import clarabel

    return {name for name in dir(clarabel.SolverStatus) if not name.startswith("_")}


def ipopt_statuses():
    casadi = pytest.importorskip("casadi")
    header = Path(casadi.__file__).parent / "include/coin-or/IpReturnCodes_inc.h"
    if not header.exists():
        pytest.skip("this casadi comes without the header of Ipopt's statuses")
    return set(
        re.findall(r"^\s*(\w+)\s*=\s*-?\d+", header.read_text().split("AlgorithmMode")[0], re.M)
    )


def cvxpy_statuses():
    from cvxpy import settings

    return {*settings.SOLUTION_PRESENT, *settings.INF_OR_UNB, *settings.INACCURATE, *settings.ERROR}


@pytest.mark.parametrize(
    ("backend", "statuses"),
    [
        (highs_backend, highs_statuses),
        (clarabel_backend, clarabel_statuses),
        (cvxpy_backend, cvxpy_statuses),
        (ipopt_backend, ipopt_statuses),
    ],
)
def test_statuses_are_mapped_by_their_names(backend, statuses):
    """Versions differ in the rarer ones; what is not listed is a failure."""
    known = set(backend.STOPS)
    assert {word for word in known if re.search("(?i)solved$|optimal$|infeasible$", word)} <= (
        statuses()
    )
    assert len(known & statuses()) > 0.8 * len(known)
    success = {word for word, stop in backend.STOPS.items() if stop.success}
    assert success <= {"kOptimal", "Solved", "AlmostSolved", "optimal", "optimal_inaccurate",
                       "Solve_Succeeded", "Solved_To_Acceptable_Level"}  # fmt: skip


def test_almost_at_a_limit_is_the_limit():
    clarabel, cvxpy = clarabel_backend._stop, cvxpy_backend._stop
    assert clarabel("AlmostSolved", 7, 200, False) is Stop.INACCURATE
    assert clarabel("AlmostSolved", 200, 200, False) is Stop.ITERATION_LIMIT
    assert clarabel("AlmostSolved", 7, 200, True) is Stop.TIME_LIMIT
    assert clarabel("a new word", 7, 200, False) is Stop.FAILED
    assert cvxpy("optimal_inaccurate", "CLARABEL", 7, None, False) is Stop.INACCURATE
    assert cvxpy("optimal_inaccurate", "CLARABEL", 7, 7, False) is Stop.ITERATION_LIMIT
    assert cvxpy("optimal_inaccurate", "CLARABEL", 7, None, True) is Stop.TIME_LIMIT
    assert cvxpy("optimal_inaccurate", "SCS", 7, None, False) is Stop.ITERATION_LIMIT
    assert cvxpy("user_limit", "OSQP", 7, None, True) is Stop.TIME_LIMIT
    assert cvxpy("a new word", "HIGHS", 7, None, False) is Stop.FAILED


# The registry ---------------------------------------------------------------------------------


def test_every_built_in_backend_carries_its_name():
    assert [import_module(BUILT_IN[name]).BACKEND.name for name in BUILT_IN] == list(BUILT_IN)
    assert list(BUILT_IN) == list(names())[: len(BUILT_IN)]


def test_no_solver_is_imported_unasked():
    code = (
        "import sys, lmdsl.backends as b\n"
        "[b.get(name) for name in b.installed()]\n"
        "print([m for m in ('highspy', 'clarabel', 'cvxpy', 'casadi') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_algorithm_that_is_not_installed_is_listed_as_such(monkeypatch, capsys):
    def none(name):
        raise registry.PackageNotFoundError(name)

    highs = get("highs")
    monkeypatch.setattr(registry, "version", none)
    assert backends.missing(highs) == {"hipo": "highspy-extras"}
    assert main(["backends"]) == 0
    assert "simplex, hipo (not installed: highspy-extras), pdlp" in capsys.readouterr().out
    assert main(["backends", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["highs"]["not_installed"] == {"hipo": "highspy-extras"}
    assert listed["clarabel"]["not_installed"] == {}
    monkeypatch.setattr(registry, "version", lambda _: "1.0")
    assert backends.missing(highs) == {}
    assert main(["backends"]) == 0
    assert "not installed" not in capsys.readouterr().out

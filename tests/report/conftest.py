"""Shared by the tests of report."""

from __future__ import annotations

import pytest
from pictures import logistic, lorenz, maze
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.report import gathering


@pytest.fixture(autouse=True)
def few_runs(monkeypatch):
    """Pages make a thousand runs each; these are told the same by some."""
    monkeypatch.setattr(gathering, "STARTS", 60)
    monkeypatch.setattr(gathering, "STEPS", 80)


@pytest.fixture(scope="module")
def solved():
    """Results by name, each solved when first asked for."""
    known = {
        "maze": maze,
        "lorenz": lorenz,
        "logistic": logistic,
        "standard": lambda: standard_map(20),
        "refused": lambda: doubling(gamma=3.0),
        "autonomous": doubling,
        "steps": steps,
    }
    results = {}

    def of(name):
        if name not in results:
            results[name] = lm.solve(made(known[name]()))
        return results[name]

    return of

"""Shared by the tests of plotting."""

from __future__ import annotations

import pytest
from pictures import cart, logistic, lorenz, maze
from problems import doubling, made, standard_map

import lmdsl as lm


@pytest.fixture(scope="module")
def solved():
    """Results by name, each solved when first asked for."""
    known = {
        "maze": maze,
        "lorenz": lorenz,
        "cart": cart,
        "logistic": logistic,
        "standard": lambda: standard_map(20),
        "refused": lambda: standard_map(20, gamma=50.0),
        "autonomous": doubling,
    }
    results = {}

    def of(name):
        if name not in results:
            results[name] = lm.solve(made(known[name]()))
        return results[name]

    return of

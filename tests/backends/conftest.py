"""Shared by the tests of backends."""

from __future__ import annotations

import pytest
from foreign_backends import PROBLEM
from problems import made

import lmdsl as lm


@pytest.fixture(scope="module")
def lp():
    return lm.compile(made(PROBLEM))


@pytest.fixture(scope="module")
def truth(lp):
    return lm.solve(lp)

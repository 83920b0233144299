"""The library against an independent, plain implementation of the problem format."""

from __future__ import annotations

import numpy as np
import pytest
from agreement import compare
from random_problems import CORNER_CASES, describe, random_problem


@pytest.mark.parametrize("case", CORNER_CASES, ids=describe)
def test_corner_cases(case):
    compare(case)


# What other versions of Python and of packages would make of them, two blocks of each tell.
BLOCKS = [pytest.param(k, marks=[pytest.mark.long] * (k > 1)) for k in range(10)]


@pytest.mark.parametrize("block", BLOCKS)
def test_random_problems(block):
    for i in range(12):
        data = random_problem(np.random.default_rng([block, i]))
        try:
            compare(data)
        except AssertionError as error:
            raise AssertionError(f"block {block}, problem {i}: {data}") from error


DISCOUNTS = [0.5, 0.9, 0.99, 1 - 2.0**-13, 0.1]


@pytest.mark.parametrize("block", BLOCKS[:5])
def test_random_problems_with_a_discount(block):
    """Some of them without an attractor, some with gamma b >= 1."""
    for i in range(12):
        rng = np.random.default_rng([100 + block, i])
        data = {**random_problem(rng), "discount": DISCOUNTS[int(rng.integers(len(DISCOUNTS)))]}
        if rng.random() < 0.4:
            data["attractor"] = {}
            data.pop("terminal_cost", None)  # refused: nothing would pay it
        if rng.random() < 0.3:
            data["gamma"] = float(rng.choice([1, 1.05, 2])) / data["discount"]
        try:
            compare(data)
        except AssertionError as error:
            raise AssertionError(f"block {block}, problem {i}: {data}") from error

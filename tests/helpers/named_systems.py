"""The systems known by name, solved."""

import functools

import numpy as np

import lmdsl as lm

NAMED = lm.systems.NAMED


@functools.cache
def solved(name):
    return lm.solve(lm.Problem.model_validate(NAMED[name].problem))


def variant(name, **changes):
    return lm.Problem.model_validate({**NAMED[name].problem, **changes})


def draw(name, count, rng):
    """Random states in the box, shape (d, count), and one control within its bounds."""
    problem = variant(name)
    axes = problem.state_box.values()
    x = np.array([rng.uniform(a.low, a.high, count) for a in axes])
    (u,) = problem.control_grid.values()
    return x, rng.uniform(u.low, u.high, count)


def images(problem, x, u):
    values = dict(zip(problem.states, x, strict=True)) | {problem.controls[0]: u}
    return np.array(problem.step()(values))

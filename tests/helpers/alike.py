"""Answers over ranks beside those of one process: what must be the same, and how close the rest."""

import re

import numpy as np
from random_problems import random_problem

import lmdsl as lm
from lmdsl.distributed.answering import Wanted, answer
from lmdsl.ranks.threaded import as_threads

WHOLE = ("control_index", "cell_status", "sure_levels")
VECTORS = {"value": 1e-12, "lower": 1e-6, "measure": 1e-9}
# Numbers that ranks sum in another order, or prove a little less of; all other facts are the same.
DIVIDES, ULPS = {1, 2, 4}, 1e-12  # numbers of ranks of the same bits; of others relative
CLOSE = {"cost", "lower_bound", "gap", "contraction"}


def sampled(seed):
    """A random problem without enclosures."""
    problem = random_problem(np.random.default_rng(seed))
    for key in ("successors", "local_controller"):
        problem.pop(key, None)
    return lm.Problem.model_validate(problem)


def joined(every, name):
    """An array of all ranks one after the other; None where they have none."""
    parts = [getattr(each, name) for each in every]
    return None if parts[0] is None else np.concatenate(parts)


def facts(found):
    """What an answer or a result says, but how long it took, and the numbers that are close."""
    said = found.to_dict()
    near = {name: said.pop(name) for name in CLOSE}
    del said["seconds"]
    said["message"] = re.sub(r"(within) [0-9.e-]+", r"\1", said["message"])
    said["cause"], said["reasons"] = found.cause, found.certificate.reasons
    said["N"] = found.partition.size
    return said, near


def require_alike(one, every):
    """Require of all ranks what one process found."""
    (said, near), (expected, about) = facts(every[0]), facts(one)
    assert said == expected
    for name, x in about.items():
        if name == "contraction":  # which depends on how far w was swept
            assert (near[name] is None) == (x is None)
        elif x is not None:
            assert abs(near[name] - x) <= 1e-6 * (1.0 if name == "gap" else abs(x))
    for other in every[1:]:
        assert facts(other) == facts(every[0])
        assert other.model_sha256 == every[0].model_sha256
    for name in WHOLE:
        assert np.array_equal(joined(every, name), getattr(one, name)), name
    for name, most in VECTORS.items():
        x, y = joined(every, name), getattr(one, name)
        inside = np.isfinite(y)
        assert np.array_equal(x[~inside], y[~inside]), name
        assert np.abs(x[inside] - y[inside]).max(initial=0) <= most * y[inside].max(initial=0)


def answers(problem, count, **wanted):
    """What every rank answers, as threads."""
    return as_threads(count, lambda ranks: answer(ranks, problem, Wanted(**wanted)))


def alike(problem, counts, **wanted):
    """Require the answer of one process of each number of ranks; return that answer."""
    options = {k: x for k, x in wanted.items() if k not in ("gathered", "whole")}
    one, first = lm.solve(problem, **options), None
    for count in counts:
        every = answers(problem, count, **wanted)
        require_alike(one, every)
        vectors = {name: joined(every, name) for name in (*VECTORS, "witness")}
        first = first or (vectors, every[0].model_sha256)
        assert every[0].model_sha256 == first[1]
        for name, x in vectors.items():
            most = 0.0 if {*counts[:1], count} <= DIVIDES else ULPS
            if name == "measure":  # which is swept to a residual
                most = VECTORS[name]
            require_near(name, x, first[0][name], most)
    return one


def require_near(name, x, y, most):
    """Require the same vector to a relative distance, to the bit where that is 0."""
    if not most:
        assert x.tobytes() == y.tobytes(), name
        return
    inside = np.isfinite(y)
    assert np.array_equal(x[~inside], y[~inside]), name
    assert np.abs(x[inside] - y[inside]).max(initial=0) <= most * y[inside].max(initial=0), name

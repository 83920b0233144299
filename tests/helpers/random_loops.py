"""Random problems, solved and proved: what is proved of boxes must happen to states in them."""

from __future__ import annotations

from problems import made
from proved_points import exceptions

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.proof import proving
from lmdsl.proof.bounds.tightening import tighten
from lmdsl.proof.checking import faults
from lmdsl.proof.cover import Cover
from lmdsl.proof.prover import Prover
from lmdsl.proof.record import Proof
from lmdsl.results.directory.proved import loop_of

AS_PROVED = {"arrives": 0, "lost": 0, "stays": 0}  # how many states do otherwise

MAPS = [
    "{a}*x + {b}*y + u", "x + {a}*sin(3*y) + u", "{a}*x*y + u", "x/(1.2 + y) + u",
    "where(x > {b}, x - 0.3, x*{a} + u)", "abs(x - {b}) + u*y", "x - u*max(x, y)",
    "{a}*floor(3*x)/3 + 0.1*u", "mod(x + {a}, 0.9) + 0.1*u",
]  # fmt: skip
FIELDS = [
    "y",
    "-x + u",
    "{a}*x - y + u",
    "u",
    "-1 - u*x",
    "sin(3*x) + u",
    "{a}*(1 - x**2)*y - x + u",
]


def some(rng, texts):
    a, b = rng.uniform(-1.2, 1.2, 2).round(2)
    return str(rng.choice(texts)).format(a=a, b=b)


def random_problem(rng):
    ode = rng.random() < 0.5
    texts = FIELDS if ode else MAPS
    formulas = {"x": some(rng, texts), "y": some(rng, texts)}
    system = {"kind": "map", "next": formulas}
    if ode:
        system = {"kind": "ode", "derivative": formulas, "step": float(rng.choice([0.1, 0.4])),
                  "substeps": int(rng.integers(1, 3)),
                  "judged": str(rng.choice(["path", "path", "endpoint"]))}  # fmt: skip
    data = {
        "format": "lmdsl/1",
        "system": system,
        "state_box": {
            name: {"low": float(low), "high": float(low + 2), "cells": int(rng.choice([5, 8])),
                   "periodic": bool(rng.random() < 0.3)}
            for name, low in zip("xy", rng.choice([-1, -0.9, 0], 2), strict=True)
        },
        "attractor": {"cells": rng.integers(0, 5, (3, 2)).tolist()},
        "control_grid": {"u": {"values": [-0.5, 0.0, 0.5]}},
        "sampling": {"kind": "grid", "per_axis": int(rng.integers(1, 3))},
        "on_exit": str(rng.choice(["forbid", "clip"])),
        "gamma": float(rng.choice([1.0, 0.9, 1.05])),
    }  # fmt: skip
    if ode and rng.random() < 0.5:
        data["cost_rate"] = "1 + x**2"
    else:
        data["stage_cost"] = "1 + x**2 + abs(u)"
    if rng.random() < 0.4:
        data["terminal_cost"] = "2 + y"
    if rng.random() < 0.3:
        data["noise"] = {"w": {"values": [-0.1, 0.1], "weights": [0.5, 0.5]}}
        for name in formulas:
            formulas[name] += " + w"
    if rng.random() < 0.3:
        data["avoid"] = {"boxes": [{"x": [0.9, 1.0]}]}
    return data


def proved(result, most):
    """A proof of at most so many boxes and some more."""
    loop = loop_of(result)
    images = loop.images(proving.SLACK, loop.whole(Deadline()))
    prover = Prover(Cover(loop.partition, loop.status), images, loop.factor, loop.entry(images))
    prover.run(lambda _: prover.cover.count > most, Deadline(), None)
    tighten(prover, lambda boxes: boxes > most, Deadline(), None)
    arrays = proving.boxes(prover)
    return loop, Proof.of(arrays, loop, seconds=0.0, holds=None, target=1.0)


def followed(draw, rng, count, most, points):
    """Draw, solve and prove so many loops, and follow random states of boxes of each.

    Yields problem, result and proof. What cannot be solved is drawn anew and does not count.
    """
    done = 0
    while done < count:
        try:
            problem = made(draw(rng))
            result = lm.solve(problem)
        except lm.BadInput:
            continue  # attractor cells that are avoided, a negative cost
        if result.status == "not_stabilizable":
            continue
        loop, proof = proved(result, most)
        assert exceptions(result, proof, points, seed=done) == AS_PROVED, problem.to_json()
        assert faults(loop, proof.arrays(), lambda: None) == [], problem.to_json()
        yield problem, result, proof
        done += 1

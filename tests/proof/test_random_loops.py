"""Random loops: whatever the axes, noise, paths and exits, what is proved of boxes happens."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made
from proved_points import exceptions

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.successors.compiled import enclosing, places
from lmdsl.proof import proving
from lmdsl.proof.bounds.tightening import tighten
from lmdsl.proof.checking import faults
from lmdsl.proof.cover import Cover
from lmdsl.proof.prover import Prover
from lmdsl.proof.record import Proof
from lmdsl.results.directory.proved import loop_of

pytestmark = pytest.mark.long  # in other versions it would find nothing else

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


def follow(seed, count, most):
    """Prove random loops; return the shares seen, and how many were proved."""
    rng = np.random.default_rng(seed)
    shares, done = np.zeros(4), 0
    while done < count:
        try:
            problem = made(random_problem(rng))
            result = lm.solve(problem)
        except lm.BadInput:
            continue  # attractor cells that are avoided, a negative cost
        if result.status == "not_stabilizable":
            continue
        loop, proof = proved(result, most)
        wrong = exceptions(result, proof, 2000, seed=done)
        assert wrong == {"arrives": 0, "lost": 0, "stays": 0}, problem.to_json()
        assert faults(loop, proof.arrays(), lambda: None) == [], problem.to_json()
        shares += proof.arrives, proof.lost, proof.stays, proof.undecided
        done += 1
    return shares / count


def test_what_is_proved_happens():
    shares = follow(0, 12, 2_000)
    assert shares[0] > 0.1


def narrow(step, given, held=None):
    """Enclose half of every box only."""
    middle, away = given.low / 2 + given.high / 2, (given.high - given.low) / 4
    return WHOLE(step, given._replace(low=middle - away, high=middle + away), held)


WHOLE = enclosing.enclose


@pytest.mark.parametrize(
    ("module", "name", "spoilt"),
    [(places, "follow", lambda *_: None), (enclosing, "enclose", narrow)],
)
def test_runs_find_out_what_is_not_enclosed(monkeypatch, module, name, spoilt):
    """Without the path, or the outer half of boxes, other things happen than are proved."""
    monkeypatch.setattr(module, name, spoilt)
    with pytest.raises(AssertionError):
        follow(2, 40, 1_000)


@pytest.mark.long
@pytest.mark.full
def test_what_is_proved_happens_in_many_loops():
    shares = follow(1, 150, 6_000)
    assert (shares > 0.001).all()

"""Time limits in what is long by another way than many cells, and with saved results."""

from __future__ import annotations

import json

import numpy as np
import pytest
from endless import Asked, checked, local, sines
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.assembly.estimates import unless_short
from lmdsl.model.lp import compile

# What is long, though there are few cells, or before there are samples ------------------------

SINES = "+".join(f"0*sin({k}*x)" for k in range(1, 130))
BOXES = [{"x": [0, 0.5 - 1e-5 * k]} for k in range(10_000)]
LONG = {
    "steps of a few states": {
        "system": {"kind": "ode", "derivative": {"x": f"-u+{SINES}"}, "step": 0.25,
                   "substeps": 1000},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 64}},
    },
    "boxes of the attractor": {"attractor": {"boxes": BOXES}},
    "boxes of avoid": {"avoid": {"boxes": [{"x": [0.9, 0.9 + 1e-6 * k]} for k in range(1, 9999)]}},
    "boxes of the measure": {"measure": {"boxes": BOXES}},
    "points": {"attractor": {"points": [[1e-7 * k] for k in range(200_000)]}},
    "density": {"measure": {"density": f"1+{SINES}"}},
    "samples of a pair": {"sampling": {"kind": "random", "points": 2 * 10**7}},
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", LONG)
def test_what_is_long_by_another_way_is_no_moment(name):
    cells = 4 if "sampl" in name else 10**6
    box = {"x": {"low": 0, "high": 1, "cells": cells}}
    problem = made({**steps(), "state_box": box, **LONG[name]})
    assert unless_short(problem, Deadline(1e-9))()
    deadline = Asked(3)
    with pytest.raises(TimeLimitReached, match="while compiling"):
        compile(problem, None, deadline)
    assert deadline.count < 10


def test_linearising_is_ended():
    problem = local(nodes=1, substeps=1000)
    kind = {"kind": "linear", "orbit": [[0]], "gain": {}}
    problem = made({**problem.to_dict(), "local_controller": kind})
    deadline = Asked(20)
    with pytest.raises(TimeLimitReached, match="while linearising along the orbit"):
        compile(problem, None, deadline)


def test_an_enclosure_is_ended_within_a_step():
    problem = local(nodes=1, substeps=30)
    cut = Asked(40)
    found = checked(problem, cut)
    assert (found.proved, found.samples) == (0, 0)
    assert cut.count < 45


@pytest.mark.long
def test_a_step_of_the_true_map_is_ended_too():
    result = lm.solve(made(sines(points=1, substeps=100)))
    whole = Asked()
    loop = result.closed_loop
    x = np.full((3, 1), 0.9)
    loop.run(x, 5, np.random.default_rng(0), whole)
    for count in (1, 30, whole.count // 2):
        late = Asked(count)
        runs = loop.run(x, 5, np.random.default_rng(0), late)
        assert late.count <= count + 1
        assert (runs.outcome == 2).all()
        assert len(runs.arrived) == 0
        assert runs.taken.max() < 5
    assert result.simulate(10, time_limit=1e-9).cut


def test_many_samples_are_sorted_to_the_same_rows(monkeypatch):
    noise = {"w": {"values": [-0.3, 0, 0.3], "weights": [0.2, 0.3, 0.5]}}
    escaping = steps(sampling={"kind": "random", "points": 30})
    escaping["system"]["next"] = {"x": "x-u/4+0.4*x"}
    noisy = {**standard_map(9), "noise": noise}
    noisy["system"] = {"kind": "map", "next": {"x": "x+y+0.1*w", "y": "y+u*sin(2*pi*x)/4"}}
    for data in (standard_map(9), noisy, escaping):
        usual = lm.compile(made(data)).digest
        with monkeypatch.context() as patch:
            patch.setattr("lmdsl.model.assembly.sampler.CHUNK", 1)
            assert lm.compile(made(data)).digest == usual
            patch.setattr("lmdsl.model.assembly.transitions.SORTED_ALONE", 1)
            assert lm.compile(made(data)).digest == usual


# Saved results --------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A result that takes more than a moment to make anew."""
    monkeypatch.setattr("lmdsl.model.assembly.estimates.SHORT", 0)
    lm.solve(made(standard_map(20))).save(tmp_path / "out")
    return str(tmp_path / "out")


def test_verify_ends_and_says_nothing_about_the_claims(saved, capsys):
    with pytest.raises(TimeLimitReached):
        lm.verify(saved, time_limit=1e-9)
    assert main(["verify", saved, "--time-limit", "1e-9", "--json"]) == 4
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "solver_failed"
    assert "time limit reached" in answer["message"]
    assert main(["verify", saved, "--time-limit", "1000", "--exact"]) == 0
    for exact in (False, True):
        whole = Asked()
        assert lm.verify(saved, exact=exact, time_limit=whole).holds
        for part in (0.3, 0.8, 0.99):
            with pytest.raises(TimeLimitReached):
                lm.verify(saved, exact=exact, time_limit=Asked(int(part * whole.count)))


def test_verify_in_rational_arithmetic_asks_between_blocks(saved, monkeypatch):
    monkeypatch.setattr("lmdsl.certificate.exact_sums.BLOCK", 10)
    few, many = Asked(), Asked()
    assert lm.verify(saved, time_limit=few).holds
    assert lm.verify(saved, exact=True, time_limit=many).holds
    assert many.count > few.count + 50


@pytest.mark.long
def test_a_local_controller_is_checked_whole_or_not_at_all(tmp_path):
    problem = local(cells=8, substeps=1)
    lm.solve(problem).save(tmp_path / "out")
    whole = Asked()
    assert lm.verify(tmp_path / "out", time_limit=whole).holds
    with pytest.raises(TimeLimitReached):  # not: "is stored as ..., but is ..."
        lm.verify(tmp_path / "out", time_limit=Asked(whole.count - 10))


def test_simulate_and_export_end_too(saved, tmp_path, capsys):
    assert main(["simulate", saved, "--time-limit", "1e-9", "--starts", "50"]) == 0
    assert "or cut off by the time limit after 0 steps" in capsys.readouterr().out
    target = tmp_path / "x"
    arguments = ["export", saved, "--format", "certificate", "--out", str(target)]
    assert main([*arguments, "--time-limit", "1e-9"]) == 4
    assert not target.exists()
    assert main([*arguments, "--time-limit", "1000"]) == 0
    assert target.exists()

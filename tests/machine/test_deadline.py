"""Time limits and interrupts, by what they end; none of these tests reads a clock."""

from __future__ import annotations

import itertools
import json
import threading
import time

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.threads import in_order
from lmdsl.model.assembly.transitions import SHORT, unless_short
from lmdsl.model.lp import compile
from lmdsl.optimize import witness
from lmdsl.results import solving


class Asked(Deadline):
    """A deadline that passes when it is asked for the n-th time."""

    def __init__(self, n=np.inf):
        super().__init__()
        self.counter, self.n, self.count = itertools.count(1), n, 0

    def __call__(self):
        self.count = next(self.counter)
        return self.count >= self.n or super().__call__()


def sines(points=4, substeps=1000, cells=4):
    """A file of a few lines with as many sines as one likes in every block."""
    text = "+".join(f"0*sin({k}*x)" for k in range(1, 50))
    return steps(
        system={"kind": "ode", "derivative": {"x": f"-u+{text}"}, "step": 0.25,
                "substeps": substeps},
        sampling={"kind": "random", "points": points},
        state_box={"x": {"low": 0, "high": 1, "cells": cells}},
    )  # fmt: skip


FOR_EVER = sines(points=10**6, cells=1000)  # 4e14 sines


@pytest.mark.parametrize("limit", [0, -1.0, float("nan"), "5", True, [1]])
def test_a_limit_is_a_positive_number(limit):
    problem = made(steps())
    for call in (lm.solve, lm.compare, lambda p, time_limit: lm.compile(p, None, time_limit)):
        with pytest.raises(lm.BadInput, match="time_limit"):
            call(problem, time_limit=limit)


def test_a_deadline_counts_down():
    assert Deadline().left is None
    assert not Deadline()()
    assert 0 < Deadline(1e6).left <= 1e6
    late = Deadline(1e-9)
    while not late():
        pass
    assert late.left == 1e-9  # what a solver is given is positive
    assert Deadline.of(late) is late
    with pytest.raises(TimeLimitReached, match=r"time limit reached while knitting; raise the lim"):
        late.check("knitting")
    interrupted = Deadline()
    interrupted.cancel()
    assert interrupted()


def test_compiling_for_ever_is_ended():
    problem = made(FOR_EVER)
    with pytest.raises(TimeLimitReached, match="while compiling"):
        lm.compile(problem, time_limit=1e-9)
    result = lm.solve(problem, time_limit=1e-9)
    assert (result.status, result.exit_status, result.solver_status) == (
        "solver_failed", 4, "time limit",
    )  # fmt: skip
    assert result.message.startswith("time limit reached while compiling")
    assert result.cost is result.lower_bound is result.gap is result.pairs is None
    assert result.cells == 1000
    assert (result.control_index == -1).all()
    assert not result.verified
    with pytest.raises(lm.BadInput, match="no model to save"):
        result.save("nowhere")
    compared = lm.compare(problem, ["policy-iteration", "highs"], time_limit=1e-9)
    assert [r.backend for r in compared.results] == ["policy-iteration", "highs"]
    assert compared.agreement is None
    assert compared.exit_status == 4
    json.dumps([result.to_dict(), compared.to_dict()], allow_nan=False)


def test_the_command_says_so(tmp_path, capsys):
    (tmp_path / "problem.json").write_text(json.dumps(FOR_EVER))
    out = tmp_path / "out"
    arguments = [str(tmp_path / "problem.json"), "--time-limit", "1e-9"]
    assert main(["solve", *arguments, "--out", str(out), "--json"]) == 4
    report = json.loads(capsys.readouterr().out)
    assert report["status"] == "solver_failed"
    assert "while compiling" in report["message"]
    assert not out.exists()
    assert main(["solve", *arguments]) == 4
    assert "while compiling" in capsys.readouterr().out
    assert main(["compare", *arguments, "--json"]) == 4
    assert len(json.loads(capsys.readouterr().out)["results"]) == 4


@pytest.mark.parametrize("threads", [1, 2])
def test_it_ends_within_a_block(monkeypatch, threads):
    monkeypatch.setattr("lmdsl.machine.threads.count", lambda: threads)
    deadline = Asked(200)  # a block of this problem asks 800,000 times
    with pytest.raises(TimeLimitReached):
        compile(made(sines(points=10**6)), None, deadline)
    assert deadline.count < 200 + 2 * threads + 2


def test_what_compiles_in_a_moment_is_compiled(monkeypatch):
    lp = lm.compile(made(standard_map(20)), time_limit=1e-9)
    assert lp.digest == lm.compile(made(standard_map(20))).digest
    monkeypatch.setattr("lmdsl.model.assembly.transitions.SHORT", 0)
    with pytest.raises(TimeLimitReached):
        lm.compile(made(standard_map(20)), time_limit=1e-9)
    assert SHORT > 0


def test_a_python_function_is_no_moment():
    problem = made({**steps(), "system": lm.systems.FunctionSystem(next=lambda x, u: [x - u / 4])})
    with pytest.raises(TimeLimitReached):
        lm.compile(problem, time_limit=1e-9)
    assert lm.solve(problem, time_limit=1e6).verified


def test_an_interrupt_ends_the_threads_that_help(monkeypatch):
    monkeypatch.setattr("lmdsl.machine.threads.count", lambda: 2)
    monkeypatch.setattr("lmdsl.model.assembly.transitions.SHORT", 0)
    deadline = Deadline()

    def interrupt(stage, done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compile(made(standard_map(50)), interrupt, deadline)
    assert deadline()


def test_an_interrupt_does_not_wait_for_the_end_of_a_long_part(monkeypatch):
    monkeypatch.setattr("lmdsl.machine.threads.count", lambda: 2)
    deadline, begun = Deadline(), threading.Event()

    def work(part):
        if threading.current_thread() is threading.main_thread():
            begun.wait()
            raise KeyboardInterrupt
        begun.set()
        for _ in range(10_000):
            if deadline():
                return "ended"
            time.sleep(0.001)
        return deadline.cancel()  # for the test to end

    cancelled = []

    def cancel():
        cancelled.append(deadline())
        deadline.cancel()

    with pytest.raises(KeyboardInterrupt):
        list(in_order(work, range(100), cancel))
    assert cancelled == [False]


def test_the_restricted_solve_gets_what_is_left(monkeypatch):
    given = []
    found = solving.first_policy.stabilizing

    def noted(lp, stop):
        given.append(stop)
        return found(lp, stop)

    monkeypatch.setattr(solving.first_policy, "stabilizing", noted)
    # Cell 0 of the first half is left half the time; the second half knows no such corner.
    data = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "where(x < 2, 2*x - where(x<1, 0, 2), x + 1)"}},
        "state_box": {"x": {"low": 0, "high": 4, "cells": 4}},
        "attractor": {"cells": [[3]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 4},
    }
    data["system"]["next"]["x"] = "where(x < 1, where(x < 0.5, x, 3.5), x + 1)"
    result = lm.solve(made({**data, "gamma": 3.0}), restrict_to_gamma=True, time_limit=1e6)
    assert result.status == "verified"
    assert result.beyond_gamma is not None
    assert len(given) == 2
    assert given[0] is given[1]


def test_verifying_ends_too_and_claims_no_more_than_it_proved(monkeypatch):
    lp = lm.compile(made(standard_map(20)))
    pair = lp.tree[1]
    whole = witness.certify(lp, pair, 1e-6)
    assert whole.certificate.stabilizing
    for n in (1, 2, 5, 20):
        cut = witness.certify(lp, pair, 1e-6, stop=Asked(n))
        assert not cut.certificate.verified
        np.testing.assert_array_equal(cut.witness.policy, pair)
        for name in ("stabilizing", "upper_bound", "lower_bound", "measure"):
            assert getattr(cut.certificate, name) <= getattr(whole.certificate, name)


def local(nodes=5, substeps=2, cells=400):
    data = sines(substeps=substeps, cells=cells)
    data["system"]["derivative"]["x"] += "+0*w-10*x"
    data["state_box"]["x"]["low"] = -1
    data["attractor"] = {"boxes": [{"x": [-0.5, 0.5]}]}
    data["noise"] = {"w": {"normal": {"std": 0.01, "points": nodes}}}
    data["control_grid"] = {"u": {"values": [0]}}
    data["local_controller"] = {"kind": "constant"}
    return made(data)


def checked(problem, *arguments, **more):
    from lmdsl.control.invariance import check
    from lmdsl.model.grid.partition import Partition
    from lmdsl.model.local_controller import LocalController
    from lmdsl.model.sets import Regions

    partition = Partition.of(problem)
    attractor = Regions.of(problem, partition).attractor
    return check(problem, LocalController.of(problem, partition, attractor), *arguments, **more)


def test_the_local_check_ends_with_what_it_knows():
    problem = local(nodes=2, substeps=1)
    whole = Asked()
    found = checked(problem, whole)
    assert found.samples == found.kept == 10_000
    assert found.proved > 0
    for part in (0.2, 0.5, 0.9, 0.99):
        cut = Asked(int(part * whole.count))
        less = checked(problem, cut)
        assert cut.count < part * whole.count + 10
        assert less.cells == found.cells
        assert less.proved <= found.proved
        assert less.kept == less.samples <= found.samples
    assert (less.samples, less.proved) > (0, 0)
    late = checked(problem, Asked(1))
    assert (late.samples, late.kept, late.proved) == (0, 0, 0)
    assert "no attractor cell is proved to be kept" in late.sentence()
    assert "0 of 0 random" in late.sentence()
    assert f"{found.proved} of {found.cells} attractor cells are proved" in found.sentence()


@pytest.mark.long
def test_the_local_check_takes_fewer_samples_where_they_are_dear():
    few = checked(local(nodes=50, substeps=100))
    assert 10 <= few.kept == few.samples < 10_000
    assert checked(local(nodes=50, substeps=100), samples=37).samples == 37


@pytest.mark.long
def test_a_directory_with_another_number_of_samples_is_verified(tmp_path):
    problem = local(cells=8, substeps=1)
    lm.solve(problem).save(tmp_path / "out")
    file = tmp_path / "out" / "certificate.json"
    data = json.loads(file.read_text())
    data["local_controller"] |= {"samples": 700, "kept": 700}
    file.write_text(json.dumps(data))
    assert lm.verify(tmp_path / "out").holds
    for false in ({"samples": 10**9, "kept": 10**9}, {"samples": 700, "kept": 701}):
        data["local_controller"] |= false
        file.write_text(json.dumps(data))
        assert not lm.verify(tmp_path / "out").holds


# What is long, though there are few cells, or before there are samples ----------------------------

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


def test_a_step_of_the_true_map_is_ended_too():
    result = lm.solve(made(sines(points=1, substeps=100)))
    whole = Asked()
    loop = result.closed_loop
    x = np.full((3, 1), 0.9)
    loop.run(x, 5, np.random.default_rng(0), whole)
    for count in (1, 30, whole.count // 2):
        late = Asked(count)
        outcome, taken, arrived = loop.run(x, 5, np.random.default_rng(0), late)
        assert late.count <= count + 1
        assert (outcome == 2).all()
        assert len(arrived) == 0
        assert taken.max() < 5
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
            patch.setattr("lmdsl.model.assembly.transitions.MANY", 1)
            assert lm.compile(made(data)).digest == usual


# Saved results ------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A result that takes more than a moment to make anew."""
    monkeypatch.setattr("lmdsl.model.assembly.transitions.SHORT", 0)
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

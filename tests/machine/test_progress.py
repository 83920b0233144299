"""What is said of work that goes on: how much is done, how long it takes, and where."""

from __future__ import annotations

import inspect
import io
import logging
import sys

import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.backends.policy_iteration import elapsed
from lmdsl.machine import memory, progress
from lmdsl.machine.progress import Forecast, Pace, ProgressLine, spoken
from lmdsl.model.assembly import estimates


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Terminal(io.StringIO):
    def isatty(self):
        return True


def lines(monkeypatch, stream, calls, always=False):
    """What a line shows of calls (seconds later, stage, fraction)."""
    monkeypatch.setattr(sys, "stderr", stream)
    clock = Clock()
    with ProgressLine(always, clock) as line:
        for later, stage, fraction in calls:
            clock.now += later
            line(stage, fraction)
    return stream.getvalue()


def test_the_time_left_is_that_of_an_even_pace():
    clock = Clock()
    pace = Pace(clock)
    assert pace.left("transitions", 0.1) is None  # when it began is not known
    clock.now += 1
    assert pace.left("transitions", 0.2) is None  # too early to say
    clock.now += 2
    assert pace.left("transitions", 0.4) == pytest.approx(6.0)  # 0.3 in 3 s
    assert pace.left("verify", -1.0) is None
    clock.now += 5
    assert pace.left("verify", 0.5) == pytest.approx(5.0)  # it began when it was first spoken of
    assert pace.left("verify", 0.4) is None  # it begins again
    clock.now += 4
    assert pace.left("verify", 1.0) == 0
    assert pace.left("verify", -1.0) is None


def test_what_changes_in_a_stage_begins_no_new_one():
    clock = Clock()
    pace = Pace(clock)
    for k in range(5):
        left = pace.left(f"prove ({k} % decided)", k / 8)
        clock.now += 3
    assert left == pytest.approx(12.0)


def test_a_terminal_shows_one_line_that_goes(monkeypatch):
    calls = [(0, "transitions", 0.0), (0.05, "transitions", 0.1), (3, "transitions", 0.25),
             (0.5, "solve", -1.0)]  # fmt: skip
    shown = lines(monkeypatch, Terminal(), calls).split("\r\x1b[K")
    assert shown[1:] == [
        "transitions   0 %", "transitions  25 %, about 9 s left", "solve ...", "",
    ]  # fmt: skip


def test_nothing_is_shown_elsewhere_unless_it_is_asked_for(monkeypatch):
    calls = [(0, "transitions", 0.0), (4, "transitions", 0.2), (7, "transitions", 0.5),
             (0.1, "verify", -1.0)]  # fmt: skip
    assert lines(monkeypatch, io.StringIO(), calls) == ""
    assert lines(monkeypatch, io.StringIO(), calls, always=True).splitlines() == [
        "lmdsl: transitions   0 %", "lmdsl: transitions  50 %, about 11 s left",
        "lmdsl: verify ...",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "stderr", None)
    with ProgressLine(always=True) as line:
        line("transitions", 0.5)


def test_a_notebook_overwrites_the_line(monkeypatch):
    monkeypatch.setattr(progress, "notebook", object)
    calls = [(0, "transitions", 0.25), (0.2, "solve", -1.0)]
    assert lines(monkeypatch, io.StringIO(), calls) == ""
    shown = lines(monkeypatch, io.StringIO(), calls, always=True)
    assert shown == "\rtransitions  25 %\rsolve ...        \r         \r"


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_a_proof_is_forecast_by_how_what_is_open_falls(power):
    """What is open falls like t^-power; in the end it is as much as may be left."""
    clock, told = Clock(), []
    tell = Forecast(lambda *what: told.append(what), 1 - 30.0**-power, None, clock)
    for k in range(1, 21):
        clock.now += 1.5
        tell("prove", 1 - (1.5 * k) ** -power)
    known = [fraction for _, fraction in told if fraction >= 0]
    assert len(known) > 10
    assert known == sorted(known)
    for k, fraction in enumerate(known):
        assert fraction == pytest.approx((20 - len(known) + k + 1) / 20, rel=1e-6)


def test_a_time_limit_ends_a_forecast():
    clock, told = Clock(), []
    tell = Forecast(lambda *what: told.append(what), 0.999, 10.0, clock)
    clock.now += 4
    tell("prove", 0.5)
    clock.now += 4
    tell("prove", 0.5)  # nothing moves
    tell("tighten", 0.7)
    clock.now += 4
    tell("refine", -1.0)
    assert told == [
        ("prove (50 % decided)", 0.4), ("prove (50 % decided)", 0.8), ("tighten", 0.8),
        ("refine", 1.0),
    ]  # fmt: skip


def test_steps_of_policy_iteration_tell_how_far_they_are():
    told = []
    lm.solve(made(standard_map(30)), progress=lambda *what: told.append(what))
    stages = [stage for stage, _ in told]
    assert stages == sorted(stages, key=["transitions", "solve", "verify"].index)
    assert set(stages) == {"transitions", "solve", "verify"}
    fractions = [fraction for stage, fraction in told if stage == "solve"][1:]
    assert len(fractions) > 3
    assert fractions[-1] == 1
    assert all(0 <= fraction <= 1 for fraction in fractions)
    assert elapsed(0, 1000) == 1
    assert elapsed(1000, 1000) == 0
    assert 0 < elapsed(999, 1000) < elapsed(10, 1000) < 1
    assert elapsed(0, 0) == 1


def test_true_shows_the_progress_of_every_long_call(capsys, tmp_path):
    problem = made(standard_map(20))
    lp = lm.compile(problem, progress=True)
    assert "lmdsl: transitions" in capsys.readouterr().err
    assert lm.compile(problem, True).digest == lp.digest  # by place
    assert "lmdsl: transitions" in capsys.readouterr().err
    result = lm.solve(lp, progress=True)
    assert capsys.readouterr().err.splitlines()[-1] == "lmdsl: verify ..."
    result.save(tmp_path / "out")
    for call, word in (
        (lambda p: lm.verify(tmp_path / "out", progress=p), "verify"),
        (lambda p: lm.gamma_max(lp, progress=p), "gamma-max"),
        (lambda p: lm.check(made(steps()), progress=p), "check"),
        (lambda p: lm.explain(lp.problem, progress=p), "explain"),
        (lambda p: lm.compare(lp, ["policy-iteration"], progress=p), "solve"),
        (lambda p: lm.solve(made(steps())).prove(progress=p), "prove (0 % decided)"),
    ):
        call(True)
        assert f"lmdsl: {word}" in capsys.readouterr().err
        call(False)
        call(None)
        assert capsys.readouterr().err == ""


def test_the_handler_of_a_call_goes_with_it():
    log = logging.getLogger("lmdsl")
    before = list(log.handlers), log.level
    with pytest.raises(lm.BadInput):
        lm.solve(made(steps()), "nonsense", progress=True)
    assert (list(log.handlers), log.level) == before
    with progress.narrated(), progress.followed():
        assert len(log.handlers) == len(before[0]) + 1
    assert (list(log.handlers), log.level) == before
    with pytest.raises(TypeError, match="unexpected keyword argument 'nonsense'"):
        lm.solve(made(steps()), nonsense=1)


def test_long_work_is_announced_once(monkeypatch, caplog):
    clock = Clock()
    monkeypatch.setattr(estimates.time, "perf_counter", clock)
    with caplog.at_level(logging.INFO, "lmdsl"):
        long = estimates.Outlook("compiling and solving take", 3.1e9, 1e8)
        for fraction in (0.001, 0.002, 0.004, 0.5, 1.0):
            long.done(fraction)
            clock.now += 0.6
    # 0.003 in 1.2 s: 400 s from the first on, less the first; and 10 s for 1e8 transitions
    assert [r.getMessage() for r in caplog.records] == [
        f"compiling and solving take about 7 min, {memory.human(3.1e9)}"
    ]
    caplog.clear()
    with caplog.at_level(logging.INFO, "lmdsl"):
        apart = estimates.Outlook("enclosing takes")
        for fraction in (0.01, 0.02, 0.03):
            apart.done(fraction)
            clock.now += 1
    assert [r.getMessage() for r in caplog.records] == ["enclosing takes about 2 min"]
    caplog.clear()
    with caplog.at_level(logging.INFO, "lmdsl"):
        short = estimates.Outlook("compiling and solving take", 3.1e9, 1e7)
        for fraction in (0.1, 0.2, 0.6, 1.0):
            short.done(fraction)
            clock.now += 2
    assert not caplog.records


def test_the_announcement_is_made_while_compiling(monkeypatch, caplog):
    monkeypatch.setattr(estimates, "LONG", 0.0)
    monkeypatch.setattr(estimates, "TOLD_AFTER", 0.0)
    with caplog.at_level(logging.INFO, "lmdsl"):
        lm.compile(made(standard_map(100)))
    assert sum("compiling and solving take about" in r.getMessage() for r in caplog.records) == 1


def test_an_exact_judge_tells_how_far_it_is(tmp_path, monkeypatch):
    from lmdsl.certificate import exact_sums
    from lmdsl.results import verification

    for module in (exact_sums, verification):
        monkeypatch.setattr(module, "BLOCK", 64)
    lm.solve(made(standard_map(20))).save(tmp_path / "out")
    told = []
    assert lm.verify(tmp_path / "out", exact=True, progress=lambda *what: told.append(what)).holds
    fractions = [fraction for stage, fraction in told if stage == "verify"]
    assert fractions[0] == -1
    assert len(fractions) > 100
    assert fractions[1:] == sorted(fractions[1:])
    assert fractions[-1] == 1


def test_times_are_spoken():
    assert [spoken(s) for s in (0.4, 89, 200, 7200, 2e6)] == [
        "0 s", "89 s", "3 min", "2 h", "23 days",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "function",
    [
        *(lm.compile, lm.solve, lm.verify, lm.compare, lm.check, lm.explain, lm.gamma_max),
        *(lm.study, lm.suggest, lm.Result.prove, lm.Result.report),
    ],
)
def test_types_say_that_progress_may_be_true(function):
    said = str(inspect.signature(function).parameters["progress"].annotation)
    assert "bool" in said
    assert "None" in said

"""Checkpoints: whole or none, continued by any number of ranks, and never trusted."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from alike import joined
from command_line import run
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.distributed.answering import Wanted, answer
from lmdsl.optimize import checkpoints
from lmdsl.optimize.checkpoints import NAME, Checkpoints
from lmdsl.ranks.threaded import as_threads

EXAMPLES = Path(__file__).parents[2] / "examples"
MAP = made(standard_map(24, gamma=1.2))


@pytest.fixture(autouse=True)
def _always(monkeypatch):
    monkeypatch.setattr(checkpoints, "EVERY", 0.0)
    monkeypatch.setattr(checkpoints, "SHARE", 0.0)


@pytest.fixture(scope="module")
def whole():
    return lm.solve(MAP)


def over(count, **wanted):
    """What so many ranks answer; 0: one process, by lm.solve."""
    if not count:
        found = lm.solve(MAP, **wanted)
        return found, found.control_index, found.value
    every = as_threads(count, lambda ranks: answer(ranks, MAP, Wanted(**wanted)))
    return every[0], joined(every, "control_index"), joined(every, "value")


def first_of(folder, monkeypatch, count):
    """Return a folder as it was when so many ranks had written their first checkpoint."""
    copy, true = folder.with_name("first"), Checkpoints._commit

    def commit(keeping, *about):
        true(keeping, *about)
        if not copy.exists():
            shutil.copytree(folder, copy)

    with monkeypatch.context() as patched:
        patched.setattr(Checkpoints, "_commit", commit)
        over(count, checkpoint=folder)
    return copy


def arrays_of(folder):
    about = json.loads((folder / NAME).read_text())
    return {
        name: folder / f"{name}.{about['save']}.npy" for name in ("control_index", "value")
    }, about


def same(found, whole):
    answered, control, value = found
    assert answered.status == "verified"
    assert answered.certificate.verified
    np.testing.assert_array_equal(control, whole.control_index)
    inside = np.isfinite(whole.value)
    assert np.array_equal(value[~inside], whole.value[~inside])
    np.testing.assert_allclose(value[inside], whole.value[inside], rtol=1e-12)


@pytest.mark.parametrize("kept_by", [0, 1, 2, 3])
def test_what_any_number_of_ranks_kept_any_number_continues(tmp_path, whole, kept_by):
    same(over(kept_by, checkpoint=tmp_path), whole)
    names = sorted(os.listdir(tmp_path))
    places, about = arrays_of(tmp_path)
    assert names == sorted([NAME, *(place.name for place in places.values())])
    assert (about["cells"], about["controls"]) == (576, 21)
    control, value = (np.load(place) for place in places.values())
    assert sum(place.stat().st_size for place in places.values()) == 12 * 576 + 2 * 128
    np.testing.assert_array_equal(control, whole.control_index)
    np.testing.assert_allclose(value, whole.value, rtol=1e-9)  # a bound on the way
    for count in (0, 1, 2, 4):
        found = over(count, resume=tmp_path)
        same(found, whole)
    assert sorted(os.listdir(tmp_path)) == names  # without --checkpoint nothing is written


@pytest.mark.parametrize(("kept_by", "count"), [(0, 0), (0, 3), (2, 0), (2, 2)])
def test_the_first_checkpoint_is_continued(tmp_path, monkeypatch, whole, kept_by, count):
    folder = first_of(tmp_path / "last", monkeypatch, kept_by)
    places, _ = arrays_of(folder)
    control, value = (np.load(place) for place in places.values())
    assert (control != whole.control_index).any()
    assert (value[control >= 0] >= whole.value[control >= 0] * (1 - 1e-9)).all()
    same(over(count, resume=folder), whole)


@pytest.mark.parametrize("kept_by", [0, 2])
def test_what_was_solved_on_some_cells_is_continued_there(tmp_path, kept_by):
    """Where gamma is infeasible for the others; rank 0 has not the whole model."""
    problem = MAP.replaced(gamma=3.5)

    def solved(count, **folders):
        if not count:
            found = lm.solve(problem, restrict_to_gamma=True, **folders)
            return found.status, found.control_index.tolist()
        wanted = Wanted(restrict_to_gamma=True, whole=0, **folders)
        every = as_threads(count, lambda ranks: answer(ranks, problem, wanted))
        return every[0].status, joined(every, "control_index").tolist()

    whole = solved(0)
    assert solved(kept_by, checkpoint=tmp_path) == whole
    control = np.load(arrays_of(tmp_path)[0]["control_index"])
    assert control.tolist() == whole[1]
    assert 0 < (control >= 0).sum() < lm.compile(problem).n
    for count in (0, 3):
        assert solved(count, resume=tmp_path) == whole


def test_a_limit_leaves_its_last_policy(tmp_path, whole):
    found = lm.solve(MAP, checkpoint=tmp_path, max_iterations=1)
    assert found.status == "solver_failed"
    places, _ = arrays_of(tmp_path)
    np.testing.assert_array_equal(np.load(places["control_index"]), found.control_index)
    same(over(0, checkpoint=tmp_path, resume=tmp_path), whole)
    np.testing.assert_array_equal(np.load(arrays_of(tmp_path)[0]["control_index"]),
                                  whole.control_index)  # fmt: skip


def test_the_same_command_begins_and_continues(tmp_path, capsys):
    file, kept = tmp_path / "p.json", tmp_path / "kept"
    file.write_text(json.dumps(standard_map(24, gamma=1.2)))
    command = ["solve", file, "--no-simulate", "--json", "--checkpoint", kept, "--resume", kept]
    reports = []
    for _ in range(2):
        status, out, error = run(capsys, *command)
        assert (status, error) == (0, "")
        reports.append(json.loads(out))
    assert reports[0]["cost"] == reports[1]["cost"]
    (tmp_path / "other").mkdir()
    for more, words in (
        (["--resume", tmp_path / "other"], "holds no checkpoint; give the folder of --checkpoint"),
        (["--resume", kept, "--gamma", "1.1"], "is that of another problem; resume the one that"),
        (["--checkpoint", file], "cannot write in"),
        (["--checkpoint", kept, "--backend", "highs"], "highs keeps none; use policy-iteration"),
    ):
        status, out, error = run(capsys, "solve", file, "--no-simulate", *more)
        assert (status, out) == (2, "")
        assert words in error
        assert error.count("\n") == 1
    with pytest.raises(lm.BadInput, match="not together with start"):
        lm.solve(MAP, resume=kept, start=lm.solve(MAP))


def test_substeps_that_are_found_and_functions_do_not_make_another_problem(tmp_path):
    pendulum = lm.load(EXAMPLES / "inverted_pendulum.json")
    counts = ("auto", 3)
    texts = {checkpoints.identity(pendulum.replaced(system=pendulum.system.replaced(substeps=n)))
             for n in counts}  # fmt: skip
    assert len(texts) == 1
    data = steps()
    data["system"] = lm.systems.FunctionSystem(next=lambda x, u: [x - 0.25 * u])
    problem = lm.Problem(**data)
    assert checkpoints.identity(problem) == checkpoints.identity(problem.replaced())
    found = lm.solve(problem, checkpoint=tmp_path)
    assert lm.solve(problem, resume=tmp_path).value.tolist() == found.value.tolist()


def test_the_identity_is_that_of_what_is_declared():
    everything = [MAP, MAP.replaced(gamma=1.1), MAP.replaced(stage_cost="1"),
                  MAP.replaced(sampling={"kind": "random", "points": 10, "seed": 1}),
                  made(standard_map(25, gamma=1.2))]  # fmt: skip
    assert len({checkpoints.identity(problem) for problem in everything}) == len(everything)
    assert checkpoints.identity(MAP) == checkpoints.identity(MAP.replaced(gamma=1.2))


@pytest.mark.parametrize("step", ["_make", "_put", "_commit"])
@pytest.mark.parametrize("after", [False, True])
def test_whenever_the_writing_ends_a_whole_checkpoint_is_there(tmp_path, monkeypatch, step, after):
    """Killed before or after a step: nothing is tidied up then."""
    lp = lm.compile(MAP)
    policy, V = lp._algorithm_1[1], np.arange(1.0, lp.n + 1)
    keeping = Checkpoints.of(tmp_path, MAP)
    keeping.keep(lp, policy, V)
    true = getattr(Checkpoints, step)

    def killed(*arguments):
        if after:
            true(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Checkpoints, step, killed)
        with pytest.raises(KeyboardInterrupt):
            keeping.keep(lp, policy, 2 * V)
    found = checkpoints.unfinished(tmp_path, lp)
    assert found.value.tolist() == ((2 if (step, after) == ("_commit", True) else 1) * V).tolist()
    assert found.control.tolist() == lp.control[policy].tolist()
    (tmp_path / "of somebody else").write_text("")
    keeping.keep(lp, policy, 3 * V)  # the next one removes what was left
    assert checkpoints.unfinished(tmp_path, lp).value.tolist() == (3 * V).tolist()
    assert len(os.listdir(tmp_path)) == 4


@pytest.mark.parametrize("count", [0, 3])
def test_a_full_disk_is_said_and_costs_no_answer(tmp_path, monkeypatch, caplog, whole, count):
    over(count, checkpoint=tmp_path)
    before, true = sorted(os.listdir(tmp_path)), Checkpoints._put

    def full(keeping, save, N, first, own):
        true(keeping, save, N, first, own)
        if first or not count:  # of ranks, not the first
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Checkpoints, "_put", full)
    same(over(count, checkpoint=tmp_path), whole)
    assert sorted(os.listdir(tmp_path)) == before
    assert f"no checkpoint was kept in {tmp_path}: no space left on device" in caplog.text


def test_time_is_shared(tmp_path, monkeypatch):
    """A checkpoint is written once it is time to, at most a tenth of it is spent so."""
    now = [1000.0]
    monkeypatch.setattr(checkpoints, "EVERY", 60.0)
    monkeypatch.setattr(checkpoints, "SHARE", 10)
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])
    lp, written = lm.compile(MAP), []

    def write(*_):
        written.append(now[0])
        now[0] += 20.0

    monkeypatch.setattr(Checkpoints, "_write", write)
    keeping = Checkpoints.of(tmp_path, MAP)
    for at in (1001.0, 1059.0, 1060.0, 1200.0, 1279.0, 1281.0):
        now[0] = at
        keeping.keep(lp, lp._algorithm_1[1], np.ones(lp.n))
    keeping.keep(lp, lp._algorithm_1[1], np.ones(lp.n), last=True)
    assert written == [1060.0, 1281.0, 1301.0]


def spoiled(content, at, how, random):
    """Return the content of a file, spoiled."""
    at = int(at * len(content))
    if how == "flipped":
        return content[:at] + bytes([content[at] ^ 1 << random.integers(8)]) + content[at + 1 :]
    if how == "cut":
        return content[:at]
    if how == "longer":
        return content + content[at:]
    fill = {"zeros": b"\0", "ones": b"\xff", "huge": np.array([1e300]).tobytes()}
    some = random.bytes(len(content)) if how == "random" else fill[how] * len(content)
    return content[:128] + some[: len(content) - 128]


SPOILED = given(
    file=st.sampled_from([0, 1, 2]), at=st.floats(0, 1, exclude_max=True), seed=st.integers(0, 99),
    how=st.sampled_from(["flipped", "cut", "longer", "zeros", "ones", "huge", "random"]),
    count=st.sampled_from([0, 0, 0, 2]),
)  # fmt: skip


@settings(max_examples=20, deadline=None, derandomize=True)
@SPOILED
def test_a_spoiled_checkpoint_is_refused_or_harmless(
    tmp_path_factory, whole, file, at, seed, how, count
):
    folder = tmp_path_factory.mktemp("kept")
    Checkpoints.of(folder, MAP).keep(whole.lp, columns(whole), whole.value[whole.lp.cells], True)
    place = [folder / NAME, *arrays_of(folder)[0].values()][file]
    place.write_bytes(spoiled(place.read_bytes(), at, how, np.random.default_rng(seed)))
    error = ""
    try:
        found = over(count, resume=folder)
    except lm.BadInput as refused:
        error = str(refused)
    if error:
        assert error.startswith("resume: ")
        assert "\n" not in error
    else:
        same(found, whole)


@pytest.mark.long
@pytest.mark.full
@settings(max_examples=500, deadline=None)
@SPOILED
def test_spoiled_checkpoints_at_length(tmp_path_factory, whole, **how):
    test_a_spoiled_checkpoint_is_refused_or_harmless.hypothesis.inner_test(
        tmp_path_factory, whole, **how
    )


def columns(found):
    """The policy of a result, as columns."""
    lp = found.lp
    return np.array([lp.column(cell, found.control_index[cell]) for cell in lp.cells])


@pytest.mark.parametrize("count", [0, 2])
def test_a_policy_that_is_not_stabilizing_is_no_beginning(tmp_path, whole, count):
    """Controls of other cells, and a V below any: nothing of it is believed."""
    lp = whole.lp
    last = lp.pair_pointer[1:] - 1
    for policy, V in ((last, np.full(lp.n, 1e-3)), (lp.pair_pointer[:-1], np.full(lp.n, 1e200))):
        Checkpoints.of(tmp_path, MAP).keep(lp, policy, V, last=True)
        same(over(count, resume=tmp_path), whole)


def test_a_checkpoint_of_other_cells_is_refused(tmp_path, whole):
    lm.solve(MAP, checkpoint=tmp_path)
    places, about = arrays_of(tmp_path)
    (tmp_path / NAME).write_text(json.dumps({**about, "cells": 9}))
    with pytest.raises(lm.BadInput, match="is of 9 cells and 21 controls, the problem has 576"):
        lm.solve(MAP, resume=tmp_path)
    (tmp_path / NAME).write_text(json.dumps({**about, "save": "../../../../etc/passwd"}))
    with pytest.raises(lm.BadInput, match="names no file of ours"):
        lm.solve(MAP, resume=tmp_path)
    (tmp_path / NAME).write_text(json.dumps({**about, "format": "lmdsl-checkpoint/9"}))
    with pytest.raises(lm.BadInput, match="is not of the format"):
        lm.solve(MAP, resume=tmp_path)
    (tmp_path / NAME).write_text(json.dumps(about))
    places["value"].unlink()
    with pytest.raises(lm.BadInput, match=r"cannot read value\.\w+\.npy: no such file"):
        lm.solve(MAP, resume=tmp_path)
    places["value"].symlink_to(places["control_index"])  # of a stranger: no link is followed
    with pytest.raises(lm.BadInput, match="it is a link"):
        lm.solve(MAP, resume=tmp_path)

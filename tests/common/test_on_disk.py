"""Rows on disk: the same bits, nothing left behind, and a full disk is a sentence."""

import errno
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.common import on_disk
from lmdsl.common.on_disk import Disk, disk_of
from lmdsl.machine import memory
from lmdsl.model.algorithm_1 import Predecessors
from lmdsl.model.assembly.estimates import Pilot, estimate, of_rows
from lmdsl.ranks.threaded import as_threads
from lmdsl.slabs import compiling
from lmdsl.slabs.digest import of_model

VECTORS = ("control_index", "value", "lower", "measure", "witness", "cell_status")
NOISE = {"w": {"values": [-0.01, 0.02], "weights": [0.25, 0.75]}}


def noisy_steps():
    data = steps()
    step = data["system"]["next"]
    return {
        **data,
        "system": {**data["system"], "next": {x: f"{text} + w" for x, text in step.items()}},
        "noise": NOISE,
    }


def unstable(cells=30):
    """Of some cells all pairs leave the box, of others some."""
    axis = {"low": -1, "high": 1, "cells": cells}
    return {
        **steps(cost="x**2 + y**2 + 0.1"),
        "system": {"kind": "map", "next": {"x": "1.5*x + 0.3*u", "y": "0.8*y + 0.3*x*u"}},
        "state_box": {"x": axis, "y": axis},
        "attractor": {"points": [{"x": 0, "y": 0}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 7}},
    }


PROBLEMS = {
    "all pairs survive": lambda: made(standard_map(16)),
    "cells are lost": lambda: made(unstable()),
    "noise": lambda: made(noisy_steps()),
    "discount": lambda: made({**steps(), "discount": 0.9}),
    "gamma is infeasible": lambda: made(standard_map(16, gamma=40.0)),
    "enclosed": lambda: made({**standard_map(16), "successors": "enclosed"}),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_same_answer_to_the_bit_and_an_empty_folder(tmp_path, name):
    problem = PROBLEMS[name]()
    in_memory = lm.solve(problem)
    stored = lm.solve(problem, rows_on_disk=tmp_path)
    assert stored.status == in_memory.status
    for vector in VECTORS:
        np.testing.assert_array_equal(getattr(stored, vector), getattr(in_memory, vector))
    assert stored.lp.digest == in_memory.lp.digest
    rows = stored.lp.rows
    for array in (rows.pointer, rows.target, rows.code, stored.lp.control, stored.lp.cost):
        assert disk_of(array).path == tmp_path
        assert not array.flags.writeable
    assert os.listdir(tmp_path) == []  # now, while all lies there: whatever ends the process


def test_predecessors_lie_beside_their_rows(tmp_path):
    lp = lm.compile(made(standard_map(16)), rows_on_disk=tmp_path)
    before, plain = Predecessors.of(lp.rows), Predecessors.of(lm.compile(lp.problem).rows)
    assert disk_of(before.pair).path == tmp_path
    np.testing.assert_array_equal(before.pair, plain.pair)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("name", ["all pairs survive", "cells are lost"])
def test_over_ranks_each_has_its_own_rows_there(tmp_path, name, count):
    problem = PROBLEMS[name]()

    def program(ranks, disk):
        lp = compiling.compiled(ranks, problem, disk=disk)
        assert (disk_of(lp.rows.target) is None) == (disk is None or not lp.n)
        return of_model(ranks, lp)

    found = as_threads(count, lambda ranks: program(ranks, Disk.of(tmp_path)))
    assert found == as_threads(1, lambda ranks: program(ranks, None)) * count
    assert os.listdir(tmp_path) == []


def test_an_array_grows_part_by_part(tmp_path):
    parts = [np.arange(5), np.zeros(0, dtype=np.int64), np.arange(300) % 7]
    for disk in (None, Disk.of(tmp_path / "deep" / "er")):
        found = on_disk.growing(disk, np.uint8, 2)
        for part in parts:
            found.append(part)
        array = found.array()
        assert array.dtype == np.uint8
        assert array.tolist() == np.concatenate(parts).tolist()
        assert (disk_of(array), disk_of(array[3:].view(np.int8))) == (disk, disk)
        assert on_disk.growing(disk, np.float64, 3).array().shape == (0,)
    assert disk_of(on_disk.beside(array, 4, np.float64)) is disk
    assert on_disk.filled(array, 2.5).tolist() == [2.5] * 305
    assert on_disk.taken(np.arange(400)[::-1], array).tolist() == (399 - array.astype(int)).tolist()


def test_a_copy_of_a_result_lies_in_memory(tmp_path):
    import copy

    lp = lm.compile(made(standard_map(16)), rows_on_disk=tmp_path)
    assert copy.deepcopy(lp) == lp
    assert disk_of(copy.deepcopy(lp).rows.target) is None


@pytest.mark.parametrize("limit", [1000, 60_000])
def test_a_full_disk_is_a_sentence_and_leaves_nothing(tmp_path, capsys, limit):
    """The limit of a file's size stands for the end of the disk: while rows come, and after."""
    file = tmp_path / "problem.json"
    file.write_text(json.dumps(standard_map(16)))
    assert run(capsys, "solve", file, "--no-simulate")[0] == 0  # kernels are compiled by now
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        status, out, error = run(capsys, "solve", file, "--rows-on-disk", tmp_path / "rows")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (status, out) == (2, "")
    assert error.startswith("lmdsl: rows_on_disk: cannot write rows to ")
    assert error.endswith("file too large; make room, or give another folder\n")
    assert os.listdir(tmp_path / "rows") == []


def test_a_disk_that_is_full_when_pairs_are_kept_is_a_sentence(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(lm.BadInput, match=r"rows_on_disk: .*no space left on device; make room"):
        lm.compile(PROBLEMS["cells are lost"](), rows_on_disk=tmp_path)
    monkeypatch.delattr(os, "posix_fallocate")  # other systems write zeros
    assert Disk(tmp_path).empty(3 * 10**6, np.uint64).tobytes() == bytes(24 * 10**6)


def test_what_does_not_fit_on_the_disk_is_refused_before(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 4, 5))
    with pytest.raises(lm.BadInput, match=r"the rows need about .* on disk and 5 B are free in"):
        lm.compile(made(standard_map(16)), rows_on_disk=tmp_path)


def test_a_problem_that_fits_with_rows_on_disk_alone_is_told_so(tmp_path, monkeypatch):
    problem = made(standard_map(300))
    limit = estimate(problem, Pilot(1.0, 10.0), on_disk=True)
    least = estimate(problem), estimate(problem, on_disk=True)
    assert least[1] <= limit < 0.8 * least[0]
    monkeypatch.setattr(memory, "available", lambda: memory.Memory(limit, "a test"))
    with pytest.raises(lm.BadInput) as refused:
        lm.solve(problem)
    words = str(refused.value)
    assert "(a test); use fewer cells, controls, sample points or noise nodes, or keep" in words
    now = f"{memory.human(least[1])} of memory and {memory.human(of_rows(problem))} there"
    assert "rows on disk (--rows-on-disk DIR, in Python rows_on_disk=DIR)" in words
    assert words.endswith(f", which takes {now}")
    assert lm.solve(problem, rows_on_disk=tmp_path).verified
    monkeypatch.setattr(memory, "available", lambda: memory.Memory(10**6, "a test"))
    with pytest.raises(lm.BadInput, match="rows on disk") as refused:
        lm.solve(problem, rows_on_disk=tmp_path)
    assert "--rows-on-disk" not in str(refused.value)  # what is there already
    with pytest.raises(lm.BadInput) as refused:
        lm.solve(problem)
    assert "--rows-on-disk" not in str(refused.value)  # what would not help


def test_ranks_count_their_own_part_of_a_problem_and_of_a_machine(monkeypatch):
    """One of four has room where one process has none; two on a machine have half of it each."""
    problem, rows = made(standard_map(300)), Pilot(1.0, 8.0)
    need = estimate(problem, rows, share=0.26)
    assert need < 0.8 * estimate(problem, Pilot(1.0, 5.0))
    assert 2 * of_rows(problem, rows, 0.25) == pytest.approx(of_rows(problem, rows, 0.5))
    monkeypatch.setattr(memory, "available", lambda: memory.Memory(need, "a test"))
    with pytest.raises(lm.BadInput, match="a test"):
        lm.compile(problem)
    as_threads(4, lambda ranks: compiling.compiled(ranks, problem))
    monkeypatch.setattr(memory, "available", lambda: memory.Memory(need // 2, "a test"))
    with pytest.raises(lm.BadInput, match=r"estimated from a few cells, on one of several ranks\)"):
        as_threads(4, lambda ranks: compiling.compiled(ranks, problem))


def test_processes_of_a_machine_share_what_is_free(tmp_path, monkeypatch):
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemAvailable: 1000 kB\n")
    monkeypatch.setattr(memory, "_processes", 1)
    alone = memory.available(tmp_path, {})
    memory.share(4)
    assert memory.available(tmp_path, {}) == (alone.bytes // 4, "free memory")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 0, 10))
    Disk(tmp_path).require(2)
    with pytest.raises(lm.BadInput, match="2 B are free"):
        Disk(tmp_path).require(3)


@pytest.mark.parametrize("count", [0, 2])
def test_a_result_is_verified_with_rows_on_disk(tmp_path, monkeypatch, count):
    lm.solve(PROBLEMS["cells are lost"](), rows_on_disk=tmp_path / "rows").save(tmp_path / "out")
    made_there, true = [], Disk.mapped
    monkeypatch.setattr(Disk, "mapped", lambda *a: made_there.append(a) or true(*a))

    def check(**ranks):
        verify = lm.distributed.verify if ranks else lm.verify
        return verify(tmp_path / "out", rows_on_disk=tmp_path / "rows", **ranks).holds

    assert all(as_threads(count, lambda ranks: check(ranks=ranks)) if count else [check()])
    assert made_there
    assert os.listdir(tmp_path / "rows") == []


@pytest.mark.parametrize("admissible", [1.0, 0.5])
def test_no_more_lies_on_disk_than_was_asked_for(tmp_path, monkeypatch, admissible):
    problem = made(standard_map(100)) if admissible == 1 else made(unstable(60))
    said, taken, true = [], [], Disk.mapped

    def mapped(disk, file, count, dtype):
        taken.append(count * np.dtype(dtype).itemsize)
        return true(disk, file, count, dtype)

    monkeypatch.setattr(Disk, "mapped", mapped)
    monkeypatch.setattr(Disk, "require", lambda _, count: said.append(count))
    lm.compile(problem, rows_on_disk=tmp_path)
    assert 0.4 * said[-1] < sum(taken) < said[-1]


@pytest.mark.parametrize("wrong", ["", 3, "file", "file/below", "a\0b"])
def test_what_is_no_folder_is_refused(tmp_path, monkeypatch, wrong):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    with pytest.raises(lm.BadInput, match=r"^rows_on_disk: "):
        lm.solve(made(standard_map(16)), rows_on_disk=wrong)


def test_rows_that_are_there_already_are_refused(tmp_path):
    lp = lm.compile(made(standard_map(16)))
    with pytest.raises(lm.BadInput, match="is compiled already"):
        lm.solve(lp, rows_on_disk=tmp_path)
    finite = lm.from_matrices(np.array([[[0.0, 1.0], [0.0, 1.0]]]), np.ones((2, 1)), targets=[1])
    with pytest.raises(lm.BadInput, match="are given, in memory"):
        lm.solve(finite, rows_on_disk=tmp_path)


SMALL = """
import resource, sys
import lmdsl as lm
from lmdsl.model.assembly.estimates import estimate
problem = lm.load(sys.argv[1])
lm.solve(lm.load(sys.argv[1].replace('problem', 'small')))
used = int(open("/proc/self/status").read().split("VmData:")[1].split()[0]) * 1024
limit = used + (estimate(problem) + estimate(problem, on_disk=True)) // 2
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
try:
    lm.solve(problem)
except lm.BadInput as error:
    print(error)
print(lm.solve(problem, rows_on_disk=sys.argv[2]).status)
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="limits what Linux counts as data")
def test_under_a_limit_that_the_system_holds(tmp_path):
    file = tmp_path / "problem.json"
    file.write_text(json.dumps(standard_map(300)))
    (tmp_path / "small.json").write_text(json.dumps(standard_map(16)))
    script = tmp_path / "script.py"
    script.write_text(SMALL)
    done = subprocess.run(
        [sys.executable, script, file, tmp_path / "rows"], capture_output=True, text=True,
        env={**os.environ, "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    refused, status = done.stdout.splitlines()
    assert "(ulimit -d)" in refused
    assert "rows_on_disk=DIR" in refused
    assert status == "verified", done.stderr

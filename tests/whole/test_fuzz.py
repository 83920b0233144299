"""Hostile problem files and result directories: an answer or one line, and nothing else.

Tried: 2,000 spoiled problem files (2,000 more in the long test), 600 spoiled result directories
(600 more), 60 names in five places each, and the largest files the format allows.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import subprocess
import sys
import zipfile
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from bad_files import BAD, RAW
from hypothesis import example, given, settings
from hypothesis import strategies as st
from problems import doubling, made, standard_map, steps
from spent import at_most
from spoiled_files import EXAMPLES, FORMULAS, spoil_bytes, spoil_data, spoiled_file
from truth import truly

import lmdsl as lm
from lmdsl.certificate.claims import Witness
from lmdsl.cli import main
from lmdsl.model.discretization import control_count, noise_nodes, sample_points
from lmdsl.results.verification import recompiled

NOISY = {"w": {"values": [0, 0.25, 1], "weights": [0.5, 0.25, 0.25]}}
SEEDS = st.integers(0, 2**40)

# Spoiling data ------------------------------------------------------------------------------


def work(problem):
    """Return how many times compiling evaluates the map, about; infinite where that is large."""
    cells = math.prod(axis.cells for axis in problem.state_box.values())
    with contextlib.suppress(lm.BadInput):
        nodes = noise_nodes(problem)
        count = cells * control_count(problem) * sample_points(problem) * len(nodes.weights)
        return count * getattr(problem.system, "substeps", 1)
    return math.inf


def one_line(error):
    """Assert that a message can be printed on one line."""
    message = str(error)
    assert message
    assert message.isprintable(), ascii(message)
    assert len(message) < 1000


# Problem files ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def loaded(path, content):
    """Load a file: a Problem, or None where it was refused in one line."""
    path.write_bytes(content)
    with at_most(20):
        try:
            problem = lm.load(path)
        except lm.BadInput as error:
            one_line(error)
            problem = None
    assert problem is None or isinstance(problem, lm.Problem)
    return problem


def try_file(folder, seed):
    rng = np.random.default_rng(seed)
    problem = loaded(folder / "problem.json", spoiled_file(rng))
    if problem is not None and work(problem) < 5e4:
        try:
            lm.compile(problem)
        except lm.BadInput as error:
            one_line(error)


@pytest.mark.long
@settings(max_examples=2000, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_spoiled_problem_files(folder, seed):
    try_file(folder, seed)


@pytest.mark.long
@settings(max_examples=2000, deadline=None, derandomize=True)
@given(seed=st.integers(2**41, 2**50))
def test_spoiled_problem_files_at_length(folder, seed):
    try_file(folder, seed)


def test_every_formula_of_the_pool(folder):
    for text in FORMULAS:
        for data in (steps(cost=text), {**steps(), "system": {"kind": "map", "next": {"x": text}}}):
            problem = loaded(folder / "formula.json", json.dumps(data).encode())
            if problem is not None:
                with contextlib.suppress(lm.BadInput):
                    lm.compile(problem)


CHILD = """
import json, sys, time, warnings
warnings.filterwarnings("error", module="lmdsl")
import lmdsl as lm
from lmdsl.certificate.claims import Witness
warm, *files = sys.argv[1:]
lm.load(warm)
def peak():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
before = peak()
report = []
for file in files:
    started = time.process_time()
    try:
        lm.load(file)
        word = "loaded"
    except lm.BadInput as error:
        word = str(error)
    spent = time.process_time() - started
    more = peak() - before
    report.append([file, word, spent, more])
print(json.dumps(report))
"""


def largest():
    """Return files near the limit, each of another kind; those of many items are smaller."""
    size, small = 15 * 2**20, 2**19
    text = json.dumps(steps())
    mark = '"stage_cost": "1"'
    assert mark in text

    def cost(value):
        return text.replace(mark, f'"stage_cost": {value}').encode()

    def values(item):
        many = ",".join([item] * (small // (len(item) + 1)))
        return text.replace("[0, 1]", f"[{many}]").encode()

    return {
        "open brackets": b"[" * size,
        "digits": cost("9" * size),
        "string": cost('"' + "a" * size + '"'),
        "sum": cost('"x' + "+x" * (size // 2) + '"'),
        "minus": cost('"' + "-" * size + 'x"'),
        "parentheses": cost('"' + "(" * size + '"'),
        "escapes": cost('"' + "\\u00e9" * (size // 6) + '"'),
        "zeros": values("0"),
        "strings": values('"a"'),
        "keys": b"{" + b",".join(b'"%07x":1' % i for i in range(small // 12)) + b"}",
        "one key": b"{" + b",".join([b'"a":1'] * (small // 6)) + b"}",
        "spaces": b" " * size,
        "not UTF-8": b'"' + b"a" * size + b"\xff",
    }


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="measures memory in kilobytes")
def test_large_files_cost_little(tmp_path):
    (tmp_path / "warm.json").write_text(json.dumps(steps()))
    files = []
    for name, content in largest().items():
        files.append(tmp_path / f"{name}.json")
        files[-1].write_bytes(content)
    call = [sys.executable, "-c", CHILD, tmp_path / "warm.json", *files]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    report = json.loads(done.stdout)
    assert len(report) == len(files)
    for file, word, seconds, kilobytes in report:
        assert word.isprintable(), file
        assert len(word) < 1000
        assert (seconds < 20, kilobytes < 300_000) == (True, True), (file, seconds, kilobytes)


AUDIT = """
import sys, warnings
warnings.filterwarnings("error", module="lmdsl")
import lmdsl as lm
from lmdsl.certificate.claims import Witness
warm, *files = sys.argv[1:]
seen, on = [], False
WATCHED = ("open", "exec", "compile", "import", "os.listdir", "os.scandir", "os.system",
           "subprocess.Popen", "socket.connect", "socket.getaddrinfo", "ctypes.dlopen",
           "pickle.find_class", "marshal.loads", "os.remove", "os.rename", "os.mkdir")
def hook(event, arguments):
    if on and event in WATCHED:
        seen.append((event, str(arguments[:1])[:200]))
sys.addaudithook(hook)
def load(file):
    try:
        lm.load(file)
    except lm.BadInput:
        pass
for file in warm.split("|"):
    load(file)
tried = 0
for file in files:
    seen.clear()
    on = True
    load(file)
    on = False
    tried += 1
    if set(seen) != {("open", str((file,)))}:
        print(file, seen)
print("tried", tried)
"""


def test_loading_opens_no_other_file_and_runs_nothing(tmp_path):
    warm = []
    for i, data in enumerate((steps(noise=NOISY), standard_map(), steps(cost="x +"), *EXAMPLES)):
        warm.append(str(tmp_path / f"warm{i}.json"))
        Path(warm[-1]).write_text(json.dumps(data))
    rng = np.random.default_rng(1)
    contents = [spoiled_file(rng) for _ in range(250)]
    contents += [json.dumps(b[1]).encode() for b in BAD] + [r[1] for r in RAW]
    contents += [json.dumps(steps(cost=text)).encode() for text in FORMULAS]
    files = []
    for i, content in enumerate(contents):
        files.append(str(tmp_path / f"{i}.json"))
        Path(files[-1]).write_bytes(content)
    done = subprocess.run(
        [sys.executable, "-c", AUDIT, "|".join(warm), *files],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout == f"tried {len(files)}\n"


# Result directories -------------------------------------------------------------------------

ARRAYS = ("control_index", "value", "lower", "measure", "cell_status", "witness")
PLACES = ("problem.json", "certificate.json", "solution.npz")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Directories of several kinds, as {file name: content}."""
    home, found = tmp_path_factory.mktemp("saved"), []
    for data in (
        steps(),
        steps(1.25, cost="1 + x"),
        steps(1.1, noise=NOISY),
        doubling(1.5),
        doubling(3.0),
        standard_map(5),
        steps(avoid={"boxes": [{"x": [0.5, 0.75]}]}),
    ):
        result = lm.solve(made(data))
        result.save(home / "out")
        found.append({name: (home / "out" / name).read_bytes() for name in PLACES})
        assert lm.verify(home / "out").holds
    return found


def flip(rng, array):
    """Change an array in place: bits, signs, order, or hostile numbers."""
    how = rng.integers(5)
    i = rng.integers(array.size)
    if how == 0:
        raw = array.view(np.uint8)
        raw[rng.integers(raw.size)] ^= np.uint8(1 << rng.integers(8))
    elif how == 1 and array.dtype.kind == "f":
        factor = 1 + rng.choice([-1, 1]) * 10.0 ** rng.uniform(-17, 1)
        array[i] *= factor
    elif how == 2 and array.dtype.kind == "f":
        array[i] = rng.choice([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e300, 1.7e308, -1.0])
    elif how == 3:
        rng.shuffle(array)
    else:
        array[i] = rng.integers(0, 7)


def spoil_arrays(rng, content):
    """Return a whole archive with other arrays: values, shapes, types, members."""
    with np.load(io.BytesIO(content)) as stored:
        arrays = dict(stored)
    for _ in range(rng.integers(1, 3)):
        how = rng.integers(8)
        a, b = rng.choice(ARRAYS, 2, replace=False)
        if how == 0 and {a, b} <= arrays.keys():
            arrays[a], arrays[b] = arrays[b], arrays[a]
        elif how == 1 and a in arrays:
            x = arrays[a]
            forms = [x[:-1], np.append(x, x), x[None], x.astype(">f8"), x[:0]]
            arrays[a] = forms[rng.integers(len(forms))]
        elif how == 2 and rng.random() < 0.3:
            arrays.pop(a, None)
        elif a in arrays and arrays[a].size:
            with np.errstate(all="ignore"):
                flip(rng, arrays[a].reshape(-1))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def spoil_archive(rng, content):
    """Return an archive with the bytes of a member changed but its checksum right."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w") as new:
        names = old.namelist()
        chosen = names[rng.integers(len(names))]
        for name in names:
            member = old.read(name)
            how = zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED
            new.writestr(name, spoil_bytes(rng, member) if name == chosen else member, how)
    return buffer.getvalue()


def spoil_result(rng, files):
    files = dict(files)
    name = PLACES[rng.choice(3, p=[0.15, 0.25, 0.6])]
    how = rng.random()
    if how < 0.25:
        files[name] = spoil_bytes(rng, files[name])
    elif name == "solution.npz":
        files[name] = (spoil_arrays if how < 0.8 else spoil_archive)(rng, files[name])
    elif how < 0.95:
        data = spoil_data(rng, json.loads(files[name]))
        files[name] = json.dumps(data).encode()
    else:
        other = PLACES[rng.integers(3)]
        files[name], files[other] = files[other], files[name]
    return files


def put(folder, files):
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)


def assert_true(folder):
    """Assert every claim of a directory that verify accepts, in fractions."""
    result = lm.Result.load(folder)
    lp = recompiled(folder, result)
    if result.status == "not_stabilizable":
        total, n = lp.rows.shares.total, lp.n
        if result.cause == "gamma":
            w = [Fraction(x) for x in result.witness[lp.cells].tolist()] + [Fraction(0)]
            assert any(w)
            assert min(w) >= 0
            for k in range(lp.K):
                inflow = sum((w[j] * s for j, s in lp.rows.exact(k)), Fraction(0)) / total
                assert w[lp.cell[k]] <= Fraction(lp.gamma) * inflow
        else:
            assert not n or not lp.weight.any() or result.cause == "require_all"
        return
    assert result.status == "verified"
    total = lp.rows.shares.total
    model, choice = [], []
    for i, (first, last) in enumerate(zip(lp.pair_pointer[:-1], lp.pair_pointer[1:], strict=True)):
        rows = []
        for k in range(first, last):
            row = {}
            for j, share in lp.rows.exact(k):
                key = -1 if j == lp.n else j
                row[key] = row.get(key, 0) + share
            rows.append((row, float(lp.cost[k])))
        model.append(rows)
        controls = lp.control[first:last].tolist()
        choice.append(controls.index(int(result.control_index[lp.cells[i]])))
    on = lp.cells
    V, W = result.value[on], result.lower[on]
    vectors = Witness(None, result.witness[on], V, W, result.measure[on])
    claims = truly(model, lp.gamma, lp.weight, choice, vectors, total)
    assert all(claims.values()), claims

    def mean(x):
        pairs = zip(lp.weight.tolist(), x.tolist(), strict=True)
        return sum((Fraction(m) * Fraction(v) for m, v in pairs), Fraction(0))

    slack = Fraction(1, 10**11)
    assert mean(V) <= Fraction(result.cost) * (1 + slack)
    assert mean(W) >= Fraction(result.lower_bound) * (1 - slack)
    assert mean(V) - mean(W) <= Fraction(result.tolerance) * mean(V)
    assert result.gamma == lp.gamma
    np.testing.assert_array_equal(result.cell_status, lp.cell_status)


def try_result(folder, saved, seed):
    rng = np.random.default_rng(seed)
    files = spoil_result(rng, saved[rng.integers(len(saved))])
    folder = folder / "result"
    put(folder, files)
    holds = None
    with at_most(50):
        try:
            result = lm.Result.load(folder)
            if work(result.problem) > 1e5:
                return
            holds = lm.verify(folder).holds
            assert lm.verify(folder, exact=True).holds >= holds
        except lm.BadInput as error:
            one_line(error)
    if holds:
        assert_true(folder)
    status, out, err = called("verify", folder)
    assert status == {True: 0, False: 1, None: 2}[holds], (out, err)
    assert err.count("\n") == (status == 2)
    if rng.random() < 0.2:
        status, out, err = called("simulate", folder, "--starts", 5, "--steps", 5)
        assert status in (0, 2), (out, err)
        assert err.count("\n") == (status == 2)


def called(*arguments):
    """Run the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(a) for a in arguments])
    for text in (out.getvalue(), err.getvalue()):
        assert text.replace("\n", "").isprintable(), ascii(text)
        assert "Traceback" not in text
    return status, out.getvalue(), err.getvalue()


@pytest.mark.long
@settings(max_examples=600, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_spoiled_results(folder, saved, seed):
    try_result(folder, saved, seed)


@pytest.mark.long
@settings(max_examples=600, deadline=None, derandomize=True)
@given(seed=st.integers(2**41, 2**50))
def test_spoiled_results_at_length(folder, saved, seed):
    try_result(folder, saved, seed)


# Names --------------------------------------------------------------------------------------

ANY = st.text(st.characters(codec=None, exclude_categories=()), max_size=40)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(name=ANY)
@example(name="\x1b[2J\x9b31m\r\x08\u2028\u202e\U000e0001\ufeff")
@example(name="\ud800")
def test_names_print_safely(folder, name):
    path = folder / "named.json"
    path.write_text(json.dumps(steps(name=name)))
    status, _, err = called("solve", path)
    surrogate = any("\ud800" <= ch <= "\udfff" for ch in name)
    assert status == (2 if surrogate else 0), err
    # The same text where a name of the format stands, or is missing.
    for data in (
        {**steps(), name: 1},
        steps(cost=name),
        {**steps(), "state_box": {name: {"low": 0, "high": 1, "cells": 4}}},
        {**steps(), "on_exit": name},
    ):
        path.write_text(json.dumps(data))
        status, _, err = called("solve", path)
        assert status in (0, 2), err
        assert err.count("\n") == (status == 2)

"""Hostile problem files: an answer or one line, and nothing else.

Tried: 2,000 spoiled problem files (2,000 more in the long test), 60 names in five places each, and
the largest files the format allows.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bad_files import BAD, RAW
from hypothesis import example, given, settings
from hypothesis import strategies as st
from one_line import NOISY, SEEDS, called, one_line, work
from problems import standard_map, steps
from spent import at_most
from spoiled_files import EXAMPLES, FORMULAS, spoiled_file

import lmdsl as lm

# Problem files --------------------------------------------------------------------------------


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
@settings(max_examples=1000, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_spoiled_problem_files(folder, seed):
    try_file(folder, seed)


@pytest.mark.long
@pytest.mark.full
@settings(max_examples=4000, deadline=None, derandomize=True)
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


# Names ----------------------------------------------------------------------------------------

ANY = st.text(st.characters(codec=None, exclude_categories=()), max_size=40)


@pytest.mark.long
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

"""Hostile result directories: a true answer or one line, and nothing else.

Tried: 600 spoiled result directories, and 600 more in the long test.
"""

from __future__ import annotations

import io
import json
import zipfile
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from one_line import NOISY, SEEDS, called, one_line, work
from problems import doubling, made, standard_map, steps
from spent import at_most
from spoiled_files import spoil_bytes, spoil_data
from truth import truly

import lmdsl as lm
from lmdsl.certificate.claims import Witness
from lmdsl.results.verification import recompiled

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


@pytest.mark.long
@settings(max_examples=200, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_spoiled_results(folder, saved, seed):
    try_result(folder, saved, seed)


@pytest.mark.long
@pytest.mark.full
@settings(max_examples=1200, deadline=None, derandomize=True)
@given(seed=st.integers(2**41, 2**50))
def test_spoiled_results_at_length(folder, saved, seed):
    try_result(folder, saved, seed)

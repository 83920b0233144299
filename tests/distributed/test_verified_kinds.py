"""Every kind of directory that ranks write is checked by all of them, as by one process."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from alike import sampled
from problems import made, standard_map
from saved_results import content, put_apart
from test_matrix import matrices, recorded
from verifications import over, require_same, saved, say

import lmdsl as lm
from lmdsl.distributed import verifying
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.results.directory import proved, vectors
from lmdsl.slabs import compiling
from lmdsl.slabs.gamma import whole

pytestmark = pytest.mark.long  # in other versions it would find nothing else

HOLD, PARTIAL = {"kind": "hold"}, {"kind": "hold", "partial": True}


def cart(local, successors):
    """A cart whose speed is controlled; A is a square about rest, of which some cells hold."""
    axis = {"low": -1, "high": 1, "cells": 10}
    return made({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x + 0.3*y", "y": "0.9*y + 0.3*u"}},
        "state_box": {"x": axis, "y": axis},
        "attractor": {"boxes": [{"x": [-0.8, 0.8], "y": [-0.8, 0.8]}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
        "stage_cost": "x**2 + y**2 + u**2",
        "sampling": {"kind": "grid", "per_axis": 3},
        "successors": successors,
        "local_controller": local,
    })  # fmt: skip


def unheld():
    """No cell of A holds."""
    return made({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x + 0.6*where(x < 0.5, 1, -1)"}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 10}},
        "attractor": {"boxes": [{"x": [0.0, 0.5]}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 3},
        "local_controller": HOLD,
    })  # fmt: skip


# Of each a problem, and what is asked for. The last three are solved over ranks alone: none holds
# the whole model, neither to solve it nor to check it.
KINDS = {
    "hold": lambda: (cart(HOLD, "sampled"), {}),
    "hold partly": lambda: (cart(PARTIAL, "sampled"), {}),
    "hold enclosed": lambda: (cart(HOLD, "enclosed"), {}),
    "unheld": lambda: (unheld(), {}),
    "all required": lambda: (sampled(9), {"require_all": True}),
    "gamma": lambda: (made(standard_map(8, 9)), {}),
    "restricted": lambda: (sampled(45), {"restrict_to_gamma": True}),
    "proved": lambda: (cart(HOLD, "enclosed"), {"proved": True}),
    "matrices": lambda: (matrices(), {}),
    "data": lambda: (recorded(), {}),
    "gamma over ranks": lambda: (made(standard_map(8, 9)), {"apart": True}),
    "a corner over ranks": lambda: (sampled(38), {"apart": True}),
    "restricted over ranks": lambda: (sampled(45), {"restrict_to_gamma": True, "apart": True}),
}


QUICK = ("hold enclosed", "unheld", "data", "matrices", "a corner over ranks",
         "restricted over ranks")  # fmt: skip


def full(*arguments, unless=False):
    """What is tried only at length."""
    return pytest.param(*arguments, marks=[pytest.mark.full] * (not unless))


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    """A function that returns the directory of a kind, and whether no rank may hold its model."""
    home = tmp_path_factory.mktemp("kinds")

    @functools.cache
    def made_of(kind):
        problem, asked = KINDS[kind]()
        apart, proof = asked.pop("apart", False), asked.pop("proved", False)
        with pytest.MonkeyPatch.context() as patch:
            limit(patch, apart)
            out = saved(problem, home / kind.replace(" ", "_"), **asked)
        if proof:
            result = lm.Result.load(out)
            proved.add(out, result, result.prove())
        return out, apart

    return made_of


def limit(patch, apart):
    """Let no rank hold a whole model, nor leave the work to the first."""
    if apart:
        patch.setattr(whole, "fits", lambda lp, most=0: lp.mesh.ranks.any(False))
    patch.setattr(verifying, "verify_alone", None)


@pytest.mark.parametrize("kind", QUICK)
def test_a_sound_directory(directory, monkeypatch, kind):
    out, apart = directory(kind)
    limit(monkeypatch, apart)
    assert require_same(out, (2, 3)).holds


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
def test_a_sound_directory_and_other_numbers_of_ranks(directory, monkeypatch, kind):
    out, apart = directory(kind)
    limit(monkeypatch, apart)
    assert require_same(out, (1, 2, 3, 4, 7)).holds


# Negative controls: what one process refuses all refuse, wherever in the box it is wrong.


def odd(name, array, k):
    """The same array with another entry."""
    array = array.copy()
    if name == "cell_status":
        array[k] = (array[k] + 4) % 7
    elif name == "control_index":
        array[k] = 1 if array[k] != 1 else 0
    elif name in ("value", "witness"):
        array[k] = 1e-3 * array[k] if 0 < array[k] < np.inf else 1.0
    else:
        array[k] = 3 * array[k] + 1 if np.isfinite(array[k]) else 1.0
    return array


def places(result, name, count=3):
    """An entry of the part of each of so many ranks; of a measure one that is not spread thin."""
    N = len(result.cell_status)
    for k in range(count):
        own = np.arange(N * k // count, N * (k + 1) // count)
        inside = own[np.isin(result.cell_status[own], (CellStatus.STABILIZED, 6))]
        held = own[(result.cell_status[own] == 0) & (result.control_index[own] >= 0)]
        yield from (some[len(some) // 2] for some in (inside, held, own) if len(some))


def require_refused(directory, monkeypatch, tmp_path, kind, name, some=slice(None)):
    out, apart = directory(kind)
    limit(monkeypatch, apart)
    result = lm.Result.load(out)
    known = [*dict.fromkeys(places(result, name))][some]
    refused = 0
    for k in known:
        array = odd(name, getattr(result, name), k)
        target = tmp_path / f"{name}{k}"
        put_apart(out, target, **{name: content(array, vectors.TYPES[name])})
        refused += not require_same(target, (2, 3)).holds
    if name != "witness":  # of which another one may serve as well
        assert refused == len(known)
    assert refused or kind == "all required"  # whose witness nobody looks at


@pytest.mark.parametrize(("kind", "name", "k"), [
    ("hold partly", "control_index", 1), ("hold enclosed", "cell_status", 2),
    ("unheld", "witness", 0), ("restricted over ranks", "witness", -1), ("data", "value", -1),
    ("matrices", "lower", 0),
])  # fmt: skip
def test_a_spoiled_entry(directory, monkeypatch, tmp_path, kind, name, k):
    require_refused(directory, monkeypatch, tmp_path, kind, name, slice(k, k + 1 or None))


@pytest.mark.full
@pytest.mark.parametrize("name", vectors.TYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_each_spoiled_entry(directory, monkeypatch, tmp_path, kind, name):
    require_refused(directory, monkeypatch, tmp_path, kind, name)


def forged(directory, monkeypatch, tmp_path, kind, changed, counts=(3,)):
    """What is found of a directory of which the certificate says something else."""
    out, apart = directory(kind)
    limit(monkeypatch, apart)
    put_apart(out, tmp_path / "out")
    said = json.loads((out / "certificate.json").read_text())
    say(tmp_path / "out", **changed(said))
    return require_same(tmp_path / "out", counts)


WRONG = {
    "above": lambda low, high: [high * 1.01, high * 1.02],
    "below": lambda low, high: [low * 0.98, low * 0.99],
    "swapped": lambda low, high: [high, low],
    "none": lambda low, high: None,
}


@pytest.mark.parametrize(("kind", "wrong"), [
    *(("gamma", wrong) for wrong in WRONG),
    *(full("a corner over ranks", wrong, unless=wrong == "above") for wrong in WRONG),
    *(full("gamma over ranks", wrong) for wrong in WRONG),
])  # fmt: skip
def test_a_wrong_bracket(directory, monkeypatch, tmp_path, kind, wrong):
    found = forged(directory, monkeypatch, tmp_path, kind,
                   lambda said: {"gamma_bar": WRONG[wrong](*said["gamma_bar"])})  # fmt: skip
    assert not found.holds
    assert "gamma_bar" in found.reasons[-1]


def test_a_bracket_that_says_less(directory, monkeypatch, tmp_path):
    """It need not be the one that ranks find: they aim at what is stored."""
    for kind in ("gamma", "a corner over ranks"):
        assert forged(directory, monkeypatch, tmp_path / kind[0], kind,
                      lambda said: {"gamma_bar": [0.5, said["gamma"]]}).holds  # fmt: skip


KEYS = {
    "gamma": {"beyond_gamma": None, "cause": "hold", "status": "verified", "pairs": 7},
    "a corner over ranks": {"beyond_gamma": None, "cause": "measure"},
    "restricted over ranks": {"beyond_gamma": None, "pairs": 1, "stabilizable_cells": 100},
    "unheld": {"cause": "gamma", "status": "verified"},
    "matrices": {"scope": "all states", "cost": 0.5},
    "data": {"data": None, "scope": "all states"},
}


@pytest.mark.parametrize(("kind", "key"), [(kind, key) for kind in KEYS for key in KEYS[kind]])
def test_a_key_that_says_something_else(directory, monkeypatch, tmp_path, kind, key):
    if (kind, key) == ("unheld", "cause"):  # C is empty indeed, where no cell holds
        return
    assert not forged(
        directory, monkeypatch, tmp_path, kind, lambda _: {key: KEYS[kind][key]}
    ).holds


@pytest.mark.parametrize(
    "name", ["holding", "proved", *map(full, ("kind", "cells", "samples", "kept"))]
)
def test_a_local_controller_that_does_less(directory, monkeypatch, tmp_path, name):
    def more(said):
        local = said["local_controller"]
        return {"local_controller": {**local, name: "lqr" if name == "kind" else local[name] + 1}}

    assert not forged(directory, monkeypatch, tmp_path, "hold enclosed", more).holds


@pytest.mark.parametrize(("name", "by"), [("arrives", 0.01), full("boxes", -1), full("steps", 1)])
def test_a_proof_that_says_more(directory, monkeypatch, tmp_path, name, by):
    out, _ = directory("proved")
    assert "proof of the true map" in require_same(out, (2,)).notes[-1]

    def more(said):
        return {"proof": {**said["proof"], name: said["proof"][name] + by}}

    assert not forged(directory, monkeypatch, tmp_path, "proved", more).holds


@pytest.mark.parametrize("share", [0.5, full(0.0), full(1.0)])
def test_a_witness_that_is_too_large(directory, monkeypatch, tmp_path, share):
    """Of a cell of some rank: then it proves no refusal."""
    out, apart = directory("a corner over ranks")
    limit(monkeypatch, apart)
    result = lm.Result.load(out)
    some, w = np.flatnonzero(result.witness), result.witness.copy()
    w[some[int(share * (len(some) - 1))]] *= 1e6
    put_apart(out, tmp_path / "out", witness=content(w, "<f8"))
    found = require_same(tmp_path / "out", (3,))
    assert not found.holds
    assert not found.certificate.refusal


def test_a_rank_that_holds_otherwise_is_found_out(directory, monkeypatch):
    out, _ = directory("hold partly")
    true = compiling.compiled

    def other(ranks, *arguments):
        lp = true(ranks, *arguments)
        hold = np.where(lp.hold >= 0, 0, -1).astype(np.int32) if ranks.rank == 1 else lp.hold
        return replace(lp, hold=hold, _known=lp._algorithm_1)

    monkeypatch.setattr(compiling, "compiled", other)
    found = over(3, out)
    assert not found.same_model
    assert any("control_index" in sentence for sentence in found.reasons)

"""The model over ranks is that of one process, to the bit, whatever their number."""

import functools
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from launching import needs_mpi, returned
from problems import made, standard_map
from random_problems import random_problem
from slab_programs import compile_file, joined

import lmdsl as lm
from lmdsl.model.assembly import transitions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone, RankError
from lmdsl.slabs import compiling, digest
from lmdsl.slabs.digest import of_model
from lmdsl.slabs.graph import levels

EXAMPLES = Path(__file__).parents[2] / "examples"
COUNTS = [1, 2, 3, 4, 7]


@functools.cache
def without_enclosures(seed):
    """A random problem that runs over ranks."""
    problem = random_problem(np.random.default_rng(seed))
    problem.pop("successors", None)
    problem.pop("local_controller", None)
    return lm.Problem.model_validate(problem)


def test_rows_of_some_cells_are_those_of_all():
    """Cut anywhere: within a block of cells, at its ends, empty."""
    problem = lm.load(EXAMPLES / "standard_map.json")
    partition = Partition.of(problem)
    sets = CellSets.of(problem, partition)
    whole = transitions.assemble(problem, partition, sets=sets)
    F = len(sets.free)
    cuts = [0, 1, F // 3 + 1, F // 2, F // 2, F - 1, F]
    parts = [
        transitions.assemble(problem, partition, sets=sets, span=(a, b))
        for a, b in itertools.pairwise(cuts)
    ]
    for name in ("control", "cost"):
        found = np.concatenate([getattr(part, name) for part in parts])
        assert found.tobytes() == getattr(whole, name).tobytes()
    for name in ("target", "code"):
        found = np.concatenate([getattr(part.rows, name) for part in parts])
        assert found.tobytes() == getattr(whole.rows, name).tobytes()
    for a, b, part in zip(cuts[:-1], cuts[1:], parts, strict=True):
        assert (np.diff(part.pair_pointer) == np.diff(whole.pair_pointer)[a:b]).all()
        first, last = whole.pair_pointer[a], whole.pair_pointer[b]
        assert (np.diff(part.rows.pointer) == np.diff(whole.rows.pointer)[first:last]).all()


@pytest.mark.parametrize("count", COUNTS)
def test_the_standard_map(count):
    file = str(EXAMPLES / "standard_map.json")
    lp = lm.compile(file)
    expected = joined(Alone(), lp), of_model(Alone(), lp)
    assert as_threads(count, lambda ranks: compile_file(ranks, file)) == [expected] * count


@pytest.mark.long
@needs_mpi
def test_the_standard_map_under_mpi():
    file = str(EXAMPLES / "standard_map.json")
    lp = lm.compile(file)
    expected = [joined(Alone(), lp), of_model(Alone(), lp)]
    found = returned(2, "compile_file", file, script="slab_programs.py")
    assert found == [expected] * 2


def compared(problem, counts, monkeypatch):
    """Require the same model over ranks as in one process; return it."""
    lp = lm.compile(problem)
    monkeypatch.setattr(digest, "BLOCK", 8)  # so that ranks share blocks, and have several
    expected = joined(Alone(), lp), of_model(Alone(), lp), lp.cell_status.tolist()
    for count in counts:

        def program(ranks):
            own = compiling.compiled(ranks, problem)
            status = np.concatenate(ranks.collect(own.cell_status))
            return joined(ranks, own), of_model(ranks, own), status.tolist()

        assert as_threads(count, program) == [expected] * count
    return lp


@pytest.mark.parametrize("seed", [*range(9), 10, 11])
def test_random_problems(seed, monkeypatch):
    """With noise, avoid cells, measures, and cells that are lost one after the other."""
    problem = without_enclosures(seed)
    compared(problem, (2, 3, 7), monkeypatch)


@pytest.mark.parametrize("seed", [1, 3, 7, 11])
@pytest.mark.parametrize("patience", [0, 1])
def test_levels_are_the_same_by_sweeps_and_by_a_search(seed, patience, monkeypatch):
    monkeypatch.setattr(levels, "PATIENCE", patience)
    compared(without_enclosures(seed), (1, 3, 4), monkeypatch)


def test_random_problems_lose_cells():
    statuses = set()
    for seed in (*range(9), 10, 11):
        statuses |= {*lm.compile(without_enclosures(seed)).cell_status.tolist()}
    assert {0, 1, 2, 3, 4} <= statuses


def test_a_discount(monkeypatch):
    problem = without_enclosures(1)
    compared(problem.replaced(discount=0.9, gamma=1.0), (2, 3), monkeypatch)


def test_a_finite_model(monkeypatch):
    random = np.random.default_rng(2)
    P = random.random((2, 30, 30)) * (random.random((2, 30, 30)) < 0.1)
    P[:, np.arange(30), np.maximum(np.arange(30) - 1, 0)] += 1.0
    P /= P.sum(axis=2, keepdims=True)
    P = np.round(P * 64) / 64
    P[:, np.arange(30), np.maximum(np.arange(30) - 1, 0)] += 1 - P.sum(axis=2)
    problem = lm.from_matrices(P, random.integers(1, 9, (30, 2)), [0], layout="states")
    assert compared(problem, (2, 3, 4), monkeypatch).n == 29


def test_more_ranks_than_cells(monkeypatch):
    problem = without_enclosures(3)
    axes = {
        name: {**axis.model_dump(exclude_unset=True), "cells": 2}
        for name, axis in problem.state_box.items()
    }
    small = problem.replaced(state_box=axes, attractor={"cells": [[0] * len(axes)]},
                             avoid=None, measure=None)  # fmt: skip
    compared(small, (7,), monkeypatch)


# Negative controls: what a model holds, its digest tells.


@pytest.mark.parametrize(
    "what", ["status", "gamma", "cells", "control", "cost", "weight", "target", "code", "pairs"]
)
def test_the_digest_tells_every_change(what):
    lp = lm.compile(without_enclosures(1))
    rows, k = lp.rows, lp.K // 2
    e = int(np.flatnonzero(rows.target < lp.n)[-1])

    def changed(array, at, by=1):
        array = array.copy()
        array[at] += by
        return array

    other = {
        "status": lambda: replace(lp, cell_status=changed(lp.cell_status, 0)),
        "gamma": lambda: replace(lp, gamma=np.nextafter(lp.gamma, 2.0)),
        "cells": lambda: replace(lp, cells=changed(lp.cells, -1)),
        "control": lambda: replace(lp, control=changed(lp.control, k)),
        "cost": lambda: replace(lp, cost=np.nextafter(lp.cost, np.inf)),
        "weight": lambda: replace(lp, weight=changed(lp.weight, 0, 2.0**-50)),
        "target": lambda: replace(lp, rows=replace(rows, target=changed(rows.target, e))),
        "code": lambda: replace(lp, rows=replace(rows, code=changed(rows.code, e))),
        "pairs": lambda: replace(
            lp,
            pair_pointer=changed(lp.pair_pointer, int(np.diff(lp.pair_pointer).argmax()) + 1, -1),
        ),
    }[what]()
    assert of_model(Alone(), other) != of_model(Alone(), lp)


def test_the_digest_tells_two_ghosts_that_are_swapped():
    """Local numbers that stand for other cells than the rows meant: no claim would see it."""

    def program(ranks, swap):
        lp = compiling.compiled(ranks, lm.load(EXAMPLES / "standard_map.json"))
        if swap and ranks.rank == 0:
            a, b = lp.mesh.own, lp.mesh.own + 1
            target = lp.rows.target.copy()
            target[lp.rows.target == a], target[lp.rows.target == b] = b, a
            lp = replace(lp, rows=replace(lp.rows, target=target))
        return of_model(ranks, lp)

    right, wrong = (as_threads(2, lambda r, s=swap: program(r, s))[0] for swap in (False, True))
    assert right != wrong


def test_ranks_with_different_problems_are_refused():
    problem = lm.load(EXAMPLES / "standard_map.json")
    with pytest.raises(RankError, match="different problems"):
        as_threads(2, lambda r: compiling.compiled(r, problem.replaced(gamma=1.0 + r.rank / 8)))


def test_a_bad_cost_is_named_as_one_process_names_it():
    problem = lm.load(EXAMPLES / "standard_map.json").replaced(stage_cost="0.9 - x")
    with pytest.raises(lm.BadInput) as alone:
        lm.compile(problem)
    with pytest.raises(lm.BadInput) as ranked:
        as_threads(3, lambda ranks: compiling.compiled(ranks, problem))
    assert str(ranked.value) == str(alone.value)


def test_a_digest_takes_the_memory_of_a_block():
    """Beside the model: no copy of its rows."""
    import tracemalloc

    lp = lm.compile(made(standard_map(120)))
    of_model(Alone(), lp)
    tracemalloc.start()
    of_model(Alone(), lp)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    arrays = (lp.rows.target, lp.rows.code, lp.rows.pointer, lp.cost, lp.control)
    assert peak < sum(array.nbytes for array in arrays) / 2  # blocks have a fourteenth of it

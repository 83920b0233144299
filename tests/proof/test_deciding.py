"""Deciding boxes: nothing is overlooked, and nothing depends on how the work is divided."""

from __future__ import annotations

import numpy as np
import pytest
from problems import doubling, made

import lmdsl as lm
from lmdsl.machine import threads
from lmdsl.machine.deadline import Deadline
from lmdsl.proof import prover as proving
from lmdsl.proof.cover import Cover
from lmdsl.proof.deciding import choosing
from lmdsl.proof.prover import Prover
from lmdsl.proof.search import ARRIVES, EVERY, LEAVING, LOST, STAYS, UNDECIDED, meet
from lmdsl.results.directory.proved import loop_of


def whirl(**more):
    """All turns inwards, but for an island that stays, and a strip that leaves."""
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "map",
            "next": {
                "x": "where(abs(x - 1.5) + abs(y + 1.5) < 0.2, 1.5 + 0.5*(x - 1.5), "
                "where(abs(x + 1.55) < 0.04, 3, 0.6*x - 0.3*y))",
                "y": "where(abs(x - 1.5) + abs(y + 1.5) < 0.2, -1.5 + 0.5*(y + 1.5), "
                "0.3*x + 0.6*y)",
            },
        },
        "state_box": {name: {"low": -2, "high": 2, "cells": 8} for name in "xy"},
        "attractor": {"boxes": [{"x": [-0.5, 0.5], "y": [-0.5, 0.5]}]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        "on_exit": "forbid",
        **more,
    }


@pytest.fixture(scope="module")
def result():
    return lm.solve(made(whirl()))


def decided(result, boxes=4_000):
    """A prover that has bisected until there are some boxes."""
    loop = loop_of(result)
    images = loop.images()
    prover = Prover(Cover(loop.partition, loop.status), images, loop.factor, loop.entry(images))
    prover.run(lambda _: prover.cover.count > boxes, Deadline(), None)
    return prover


def test_what_is_undecided_cannot_be_decided(result):
    """No undecided box meets only what arrives, only what is lost, or only what stays."""
    prover = decided(result)
    tree, leaves = prover.cover.tree, prover.cover.leaves()
    leaves = leaves[tree.images[leaves] > 0]
    assert len(np.unique(tree.state[leaves])) == 4  # some of each kind
    for b in leaves:
        bits = meet(prover.search, b, EVERY).bits
        if tree.state[b] == UNDECIDED:
            assert bits not in {1 << state for state in (ARRIVES, LOST, STAYS)}
        else:
            assert bits == 1 << tree.state[b]


def test_levels_follow_from_what_is_met(result):
    """What a box meets was decided in an earlier round; so its level is above theirs."""
    prover = decided(result)
    tree, leaves = prover.cover.tree, prover.cover.leaves()
    for b in leaves[tree.images[leaves] > 0]:
        met = meet(prover.search, b, EVERY)
        if tree.state[b] == LOST:
            assert tree.level[b] == met.level + 1
        elif tree.state[b] == ARRIVES:
            assert tree.level[b] > met.level


def test_what_stays_is_the_greatest_set(result):
    """Undecided boxes are removed one by one that meet what is removed: none is left."""
    prover = decided(result)
    tree, leaves = prover.cover.tree, prover.cover.leaves()
    left = set(leaves[(tree.images[leaves] > 0) & (tree.state[leaves] == UNDECIDED)].tolist())
    search = prover.search
    search.mark[:] = 1  # whatever is undecided counts as left ...
    while True:
        for n in left:  # ... but for these
            search.mark[n] = 0
        gone = {b for b in left if meet(search, b, LEAVING).bits & ~(1 << STAYS)}
        if not gone:
            break
        for n in gone:
            search.mark[n] = 1
        left -= gone
    assert not left
    assert prover.shares()[STAYS] > 0


def test_shares_are_kept_up_to_date(result):
    loop, seen = loop_of(result), []
    cover = Cover(loop.partition, loop.status)
    prover = Prover(cover, loop.images(), loop.factor, loop.entry(loop.images()))

    def enough(shares):
        seen.append((shares.copy(), prover.shares()))
        return cover.count > 2_000

    prover.run(enough, Deadline(), None)
    for kept, counted in seen:
        assert kept == pytest.approx(counted, abs=1e-12)
        assert kept.sum() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(("alone", "part", "count"), [(0, 3, 1), (0, 64, 3), (2**20, 1, 1)])
def test_nothing_depends_on_how_the_work_is_divided(monkeypatch, result, alone, part, count):
    whole = decided(result).cover
    monkeypatch.setattr(threads, "count", lambda: count)
    monkeypatch.setattr(proving, "ALONE", alone)
    monkeypatch.setattr(proving, "PART", part)
    parts = decided(result).cover
    assert parts.count == whole.count
    for name in ("cell", "child", "split", "place", "state", "level", "waits"):
        one, other = (getattr(cover.tree, name)[: whole.count] for cover in (whole, parts))
        if name == "level":  # rounds of a few nodes are counted alike
            one, other = np.argsort(one, kind="stable"), np.argsort(other, kind="stable")
        np.testing.assert_array_equal(one, other)


def test_the_volume_that_waits_is_that_of_all_before():
    """0 and 1 wait for 2, that for 3, which waits for nothing; 4 and 5 for each other, 6 for 4."""
    result = lm.solve(made(doubling()))
    cover = decided(result, 0).cover
    tree = cover.tree
    leaves = np.arange(7)
    for n, w in zip(leaves, [2, 2, 3, -1, 5, 4, 4], strict=True):
        tree.waits[n], tree.split[n] = w, n % 2
    up, size, waiting, order = (np.empty(7, dtype=np.int32) for _ in range(4))
    score, position = np.empty(7), np.empty(len(tree.cell), dtype=np.int32)
    choosing.worth(tree, leaves, position, up, size, score, waiting, order)
    volume = 0.5 ** (leaves % 2)
    circle = volume[4:].sum()
    assert score.tolist() == [
        volume[0], volume[1], volume[:3].sum(), volume[:4].sum(), circle, circle, volume[6],
    ]  # fmt: skip
    assert waiting.tolist() == [0, 0, 0, 0, choosing.LARGEST, choosing.OTHER, 0]

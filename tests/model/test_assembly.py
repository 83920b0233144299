"""The assembly kernels against plain references, and independence of blocks and threads."""

import math
import os
import time
from collections import Counter

import numpy as np
import pytest
from problems import made, standard_map

import lmdsl as lm
from lmdsl.machine import threads
from lmdsl.model.assembly import merging, sampler
from lmdsl.model.assembly.merging import BlockRows, Numbering, mean_cost, merge, tile
from lmdsl.model.grid import axis
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.grid.partition import Partition


def cell_of(x, low, high, cells, periodic, clip):
    """The cell of a point on one axis, word for word as docs/problem-file.md has it."""
    if not math.isfinite(x):
        return -1
    span = high - low
    if periodic and not low <= x <= high:
        q = (x - low) / span
        if not abs(q) < 2.0**60 or abs(math.floor(q)) > 2**20:
            return -1
        r = min(max((x - low) - math.floor(q) * span, 0.0), span)
        x = min(low + r, high)
    elif clip and not periodic:
        x = min(max(x, low), high)
    width = span / cells
    t = (x - low) / width
    if not math.isfinite(t):
        return -1
    k = math.floor(t + EDGE)
    if periodic:
        return k % cells
    if k >= cells and (x <= high or t - cells <= EDGE):
        return cells - 1
    return k if 0 <= k < cells else -1


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize(("low", "high", "cells"), [(0, 1, 50), (-0.3, 2.1, 7), (3.0, 9.7, 1)])
def test_a_point_lies_in_the_cell_that_the_format_says(low, high, cells, periodic, clip):
    rng = np.random.default_rng(0)
    span, width = high - low, (high - low) / cells
    edges = low + np.arange(-3 * cells, 4 * cells) * width
    near = [edges * (1 + a) + b * width for a in (0, 2e-16, -2e-16) for b in (0, EDGE, -EDGE)]
    huge = [s * 10.0**e for s in (1, -1) for e in range(2, 308, 9)] + [
        2.0**20 * span,
        2.0**51 * width,
        1.7e308,
    ]
    odd = [math.nan, math.inf, -math.inf, 0.0, -0.0, low, high, 5e-324]
    x = np.concatenate([*near, rng.uniform(low - 9, high + 9, 500), huge, odd])
    data = standard_map(8)
    data["state_box"]["x"] = {"low": low, "high": high, "cells": cells, "periodic": periodic}
    data["attractor"] = {"cells": [[0, 0]]}
    partition = Partition.of(made(data))
    found = partition.locate([x, np.zeros(())], clip)
    expected = [cell_of(float(v), low, high, cells, periodic, clip) for v in x]
    assert (found // 8).tolist() == expected  # y = 0 is cell 0 of 8


def test_indices_broadcast_and_one_axis_outside_is_outside():
    partition = Partition.of(made(standard_map(10)))
    x, y = np.array([0.05, math.nan, 0.95]), np.array([[0.25], [math.inf]])
    assert partition.locate([x, y]).tolist() == [[2, -1, 92], [-1, -1, -1]]
    assert partition.locate([y, x]).tolist() == [[20, -1, 29], [-1, -1, -1]]
    assert partition.locate([np.float64(0.5), np.float64(0.5)]).shape == ()


@pytest.mark.parametrize("samples", [1, 2, 3, 10, 65])
@pytest.mark.parametrize("cells_last", [True, False])
@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("kind", [np.int32, np.int64])
def test_rows_count_the_samples_of_each_target_and_group(samples, cells_last, groups, kind):
    rng = np.random.default_rng(samples)
    (cells, controls), N = (41, 7) if cells_last else (3, 150), 12
    index = rng.integers(0, N, (cells, controls, samples)).astype(float)
    index[rng.random(index.shape) < 0.3 / samples] = np.nan
    number = rng.integers(0, 5, N).astype(np.int32)
    number[3] = -1
    group, bits = rng.integers(0, groups, samples).astype(kind), (groups - 1).bit_length()
    first_code = np.arange(groups) * samples
    mean = rng.random((cells, controls))
    laid = [index.transpose(1, 2, 0), mean.T] if cells_last else [index.transpose(0, 2, 1), mean]
    pairs = cells * controls
    rows = BlockRows(
        np.zeros(cells, dtype=np.int64),
        np.empty(pairs, dtype=np.int32),
        np.empty(pairs),
        np.empty(pairs, dtype=np.int64),
        np.empty(pairs * samples, dtype=np.int32),
        np.empty(pairs * samples, dtype=np.uint32),
    )
    per_cell, control, cost, end, target, code = rows
    high, wide = tile(cells_last, controls)
    kept, entries = merge(
        np.ascontiguousarray(laid[0]), cells_last, np.ascontiguousarray(laid[1]),
        Numbering(number, group, bits, first_code), np.empty((samples, high * wide), dtype=kind),
        high, wide, rows,
    )  # fmt: skip
    expected = []
    for c in range(cells):
        for a in range(controls):
            x = index[c, a]
            if np.isnan(x).any() or (number[x.astype(int)] < 0).any():
                continue
            count = Counter(zip(number[x.astype(int)].tolist(), group.tolist(), strict=True))
            row = [(t, first_code[g] + n - 1) for (t, g), n in sorted(count.items())]
            expected.append((c, a, mean[c, a], row))
    assert kept == len(expected)
    assert entries == sum(len(row) for *_, row in expected)
    assert per_cell.tolist() == np.bincount([c for c, *_ in expected], minlength=cells).tolist()
    assert control[:kept].tolist() == [a for _, a, *_ in expected]
    assert cost[:kept].tolist() == [g for *_, g, _ in expected]
    assert end[:kept].tolist() == np.cumsum([len(row) for *_, row in expected]).tolist()
    flat = [entry for *_, row in expected for entry in row]
    found = zip(target[:entries].tolist(), code[:entries].tolist(), strict=True)
    assert list(found) == flat


@pytest.mark.parametrize("length", [1, 2, 5, 16, 33, 100])
def test_the_network_sorts(length):
    key = np.random.default_rng(length).integers(-3, 9, (length, 40)).astype(np.int32)
    expected = np.sort(key, axis=0)
    merging._sort(key, 40)
    assert (key == expected).all()


@pytest.mark.parametrize("shape", [(3, 4, 2, 5), (3, 1, 2, 5), (3, 4, 1, 5), (1, 1, 1, 1)])
def test_costs_are_averaged_in_the_order_of_the_samples(shape):
    cost, weights = np.random.default_rng(0).random(shape), np.array([0.3, 0.7])
    mean = np.zeros((shape[0], shape[3]))
    mean_cost(cost, 4, weights, mean, mean.copy())
    total = 0.0
    for sample in np.broadcast_to(cost, (shape[0], 4, 2, shape[3])).transpose(1, 2, 0, 3):
        for weight, g in zip(weights, sample, strict=True):
            total = total + weight * g
    assert (mean == total / (4 * weights.sum())).all()


@pytest.mark.parametrize("bad", [-1e-300, math.nan, math.inf, -math.inf])
def test_a_bad_cost_of_one_sample_spoils_the_mean(bad):
    cost = np.ones((1, 3, 1, 4))
    cost[0, 1, 0, 2] = bad
    mean = np.zeros((1, 4))
    mean_cost(cost, 3, np.ones(1), mean, mean.copy())
    assert np.isnan(mean).tolist() == [[False, False, True, False]]


def test_rows_do_not_depend_on_the_number_of_threads(monkeypatch):
    digests = set()
    for count in (1, 2, 5):
        monkeypatch.setattr(threads, "count", lambda count=count: count)
        monkeypatch.setattr(sampler, "CHUNK", 3000)
        digests.add(lm.compile(made(standard_map(20))).digest)
    assert len(digests) == 1


@pytest.mark.parametrize("count", [1, 2, 7])
def test_each_part_is_worked_on_once(monkeypatch, count):
    monkeypatch.setattr(threads, "count", lambda: count)
    for total in (0, 1, 2, 50):
        parts = threads.ranges(100, total) if total else []
        assert [k for first, last in parts for k in range(first, last)] == list(
            range(100 if total else 0)
        )
        assert threads.each(lambda part: part, parts) == parts

    def work(x):
        if x in (20, 21, 40):
            raise ValueError(str(x))
        return threads.each(lambda y: x + y, range(3))  # helpers do not wait for helpers

    assert threads.each(work, range(20)) == [[x, x + 1, x + 2] for x in range(20)]
    with pytest.raises(ValueError, match="20"):
        threads.each(work, range(50))
    assert threads.each(abs, [-1, -2]) == [1, 2]  # and goes on after an error


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_threads_work_after_a_fork(monkeypatch):
    monkeypatch.setattr(threads, "count", lambda: 2)
    assert threads.each(abs, range(8)) == list(range(8))
    child = os.fork()
    if not child:
        os._exit(0 if threads.each(abs, range(8)) == list(range(8)) else 1)
    for _ in range(200):
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.05)
    else:
        os.kill(child, 9)
        os.waitpid(child, 0)
        pytest.fail("the child waits for threads it does not have")
    assert status == 0


@pytest.mark.parametrize("count", [1, 2, 7])
def test_results_come_in_order_and_the_first_error_ends_them(monkeypatch, count):
    monkeypatch.setattr(threads, "count", lambda: count)
    assert list(threads.in_order(lambda x: x * x, range(50))) == [x * x for x in range(50)]

    def work(x):
        if x >= 20:
            raise ValueError(str(x))
        return x

    seen = []
    with pytest.raises(ValueError, match="20"):
        seen.extend(threads.in_order(work, range(10**9)))
    assert seen == list(range(20))


def test_circles_of_every_number_of_cells():
    """The first cell of the next turn must not become the cell after the last."""
    for cells in range(1, 400):
        k = np.concatenate([np.arange(-3 * cells, 3 * cells), cells * 10.0 ** np.arange(2, 7)])
        index = np.zeros(len(k))
        axis.circle(k + 0.5, 0.0, float(cells), 1.0, float(cells), 1.0, index)
        np.testing.assert_array_equal(index, k % cells)

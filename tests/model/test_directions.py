"""Sweeps along the axes of a box: every direction once in a cycle, and news carried all the way."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from lmdsl.model.grid import directions
from lmdsl.model.grid.directions import Directions
from lmdsl.optimize.linear import gauss_seidel
from lmdsl.optimize.linear.substitution import Peeled

SHAPES = st.lists(st.integers(1, 5), min_size=1, max_size=5).map(tuple)


@st.composite
def parts_of_boxes(draw):
    shape = draw(SHAPES)
    size = int(np.prod(shape))
    cells = draw(st.lists(st.integers(0, size - 1), min_size=1, unique=True, max_size=60))
    return Directions(np.array(sorted(cells)), shape, draw(st.booleans()))


def visits(of):
    """Return the positions visited by each sweep of a cycle."""
    return [of.orders[k][::-1] if down else of.orders[k] for k, down in of.cycle]


def signs_of(shape):
    """Return the signs of the axes in each sweep of a cycle, by counting in Gray code."""
    free = min(len(shape), 1 + directions.MOST_FLIPPED)
    for k in range(2**free):
        flips = [1 - 2 * (((k ^ (k >> 1)) >> j) & 1) for j in range(free)]
        yield [flips[0]] * (len(shape) - free + 1) + flips[1:]


@given(parts_of_boxes())
@settings(deadline=None)
def test_each_sweep_visits_every_cell_in_the_order_of_its_signed_axes(of):
    wanted = []
    for signs in signs_of(of.shape):
        index = np.array(np.unravel_index(of.cells, of.shape)) * np.array(signs)[:, None]
        wanted.append(np.lexsort(index[::-1]))
    if of.against:
        wanted = [wanted[0], *wanted[:0:-1]]
    assert len(visits(of)) == len(wanted)
    for found, order in zip(visits(of), wanted, strict=True):
        np.testing.assert_array_equal(found, order)


@given(parts_of_boxes(), st.data())
@settings(deadline=None)
def test_some_of_the_cells_are_visited_in_the_same_order(of, data):
    chosen = np.flatnonzero(data.draw(st.lists(
        st.booleans(), min_size=len(of.cells), max_size=len(of.cells)
    )))  # fmt: skip
    part = of.among(chosen)
    if data.draw(st.booleans()):
        part = part.reversed().reversed()
    for found, order in zip(visits(part), visits(of), strict=True):
        np.testing.assert_array_equal(chosen[found], order[np.isin(order, chosen)])


@given(parts_of_boxes())
@settings(deadline=None)
def test_halves_are_visited_in_the_same_order(of):
    middle = len(of.cells) // 2
    for order, halved in zip(of.orders, of.in_halves, strict=True):
        np.testing.assert_array_equal(halved[:middle], order[order < middle])
        np.testing.assert_array_equal(halved[middle:], order[order >= middle])


def test_cells_without_a_box_are_swept_up_and_down():
    up, down = visits(Directions.line(5))
    np.testing.assert_array_equal(up, np.arange(5))
    np.testing.assert_array_equal(down, np.arange(5)[::-1])


def drift(shape, signs):
    """Return a flow along every axis by one cell, in equal shares, out at the far faces."""
    size, d = int(np.prod(shape)), len(shape)
    index = np.array(np.unravel_index(np.arange(size), shape))
    M = sp.lil_array((size, size))
    for axis, sign in enumerate(signs):
        to = index.copy()
        to[axis] += sign
        inside = (to[axis] >= 0) & (to[axis] < shape[axis])
        M[np.flatnonzero(inside), np.ravel_multi_index(to[:, inside], shape)] = 1 / d
    return sp.csr_array(M)


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize(
    ("shape", "cycles"), [((30,), 1), ((12, 17), 1), ((6, 7, 8), 1), ((3, 4, 5, 4), 4)]
)
def test_a_cycle_solves_a_flow_whatever_its_direction(shape, cycles, transposed):
    """With more than three axes the first ones turn together: some cycles more."""
    for signs in product((1, -1), repeat=len(shape)):
        M = drift(shape, signs)
        size = M.shape[0]
        system = replace(
            gauss_seidel.SplitMatrix.of(M), directions=Directions(np.arange(size), shape)
        )
        matrix = M
        if transposed:
            system, matrix = system.transposed(), M.T
        b = np.linspace(1.0, 2.0, size)
        x = b.copy()
        system.sweep(b, x, cycles * len(system.directions.cycle), enough=0.0)
        np.testing.assert_allclose(x - matrix @ x, b, rtol=1e-13)


def test_up_and_down_alone_takes_more():
    M = drift((12, 17), (1, -1))
    b = np.ones(M.shape[0])
    x = b.copy()
    gauss_seidel.SplitMatrix.of(M).sweep(b, x, 4, enough=0.0)
    assert np.abs(x - M @ x - b).max() > 1e-3


def test_two_halves_are_swept_in_the_same_directions(monkeypatch):
    monkeypatch.setattr(gauss_seidel, "PARALLEL_FROM", 10)
    for signs in product((1, -1), repeat=2):
        M = drift((12, 17), signs)
        system = replace(
            gauss_seidel.SplitMatrix.of(M), directions=Directions(np.arange(204), (12, 17))
        )
        b = np.ones(204)
        x = b.copy()
        system.sweep(b, x, 12, enough=0.0)  # news crosses from one half to the other once
        np.testing.assert_allclose(x - M @ x, b, rtol=1e-13)


def test_the_core_keeps_the_directions_of_its_cells():
    shape = (9, 11)
    rng = np.random.default_rng(4)
    M = (drift(shape, (1, 1)) + drift(shape, (-1, -1))) * 0.4
    outside = rng.random(99) < 0.4  # leads nowhere but out of the box; nothing leads there
    keep = sp.dia_array(((~outside).astype(float)[None], [0]), shape=(99, 99)).tocsr()
    system = replace(
        gauss_seidel.SplitMatrix.of(sp.csr_array(M @ keep)),
        directions=Directions(np.arange(99), shape),
    )
    peeled = Peeled.of(system)
    assert 0 < len(peeled.core) < 99
    np.testing.assert_array_equal(peeled.inner.directions.cells, peeled.core)
    assert peeled.inner.directions.shape == shape

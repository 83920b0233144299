"""Spectrum and decay of the closed loop: closed forms, other ways to them, and hard cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import doubling, made, standard_map, steps
from scipy.sparse import csr_array

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.report.decay import LEADING, _leading, closed_loop_of, decay, spectrum

EVER = Deadline()


def loop_of(data):
    result = lm.solve(made(data))
    return result, closed_loop_of(result, result.lp, EVER)


def test_three_steps_and_it_is_over():
    _, loop = loop_of(steps())
    assert loop["radius"] == 0
    assert loop["eigenvalues"] == [[0.0, 0.0]]
    assert loop["steps"] == [0, 1, 2, 3]
    assert loop["left"] == pytest.approx([1, 2 / 3, 1 / 3, 0])
    assert loop["mean"] == pytest.approx(2)


def test_half_of_it_stays():
    _, loop = loop_of(doubling())
    assert loop["radius"] == 0.5
    assert loop["left"][:4] == [1, 0.5, 0.25, 0.125]
    assert loop["mean"] == pytest.approx(2, abs=1e-8)


def test_a_discount_ends_runs():
    """x+ = 2x modulo 1 on 2 cells, half of the mass stays, and 0.8 of that goes on."""
    _, loop = loop_of(doubling(discount=0.8))
    assert loop["radius"] == pytest.approx(0.4)


def test_what_is_nilpotent_has_the_spectrum_zero():
    """Eigenvalues of the whole matrix at once say otherwise: they are as large as 0.8."""
    n = 300
    order = np.random.default_rng(0).permutation(n)
    P = np.zeros((n, n))
    P[order[:-1], order[1:]] = 0.7
    P[order[:-2], order[2:]] = 0.3
    assert spectrum(csr_array(P), EVER)[0] == 0


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_the_spectrum_is_that_of_the_whole_matrix(n, seed):
    rng = np.random.default_rng(seed)
    P = rng.random((n, n)) * (rng.random((n, n)) < 0.3)
    P /= np.maximum(P.sum(axis=1, keepdims=True) / rng.random((n, 1)), 1e-300)
    radius, found, complete = spectrum(csr_array(P), EVER)
    whole = np.abs(np.linalg.eigvals(P)).max()
    assert complete
    assert radius == pytest.approx(whole, abs=1e-4)
    assert np.abs(found).max() == radius


def test_a_large_part_by_arnoldi():
    """Of 500 cells, each of which keeps 0.8 of its mass and spreads it at random: Perron's root.

    The others lie close together in a small disk: whether all of them converge is ARPACK's affair.
    """
    P = np.random.default_rng(0).random((500, 500))
    P *= 0.8 / P.sum(axis=1, keepdims=True)
    radius, found, _ = spectrum(csr_array(P), EVER)
    assert radius == pytest.approx(0.8, abs=1e-9)
    assert (np.abs(found[1:]) < 0.1).all()


def test_conjugates_stay_together():
    """A cycle of 31 cells has the 31st roots of its product: 15 pairs, and the list ends in one."""
    n = 31
    P = csr_array(0.9 * np.roll(np.eye(n), 1, axis=1))
    _, found, _ = spectrum(P, EVER)
    assert LEADING <= len(found) <= LEADING + 1
    for z in found:
        assert np.abs(found - z.conj()).min() < 1e-9
    cut = np.array([0.5, 0.3 + 0.2j, 0.3 - 0.2j, 0.1 + 0.3j])
    assert np.allclose(_leading(cut), [*cut, 0.1 - 0.3j])


def test_what_is_not_finished_is_no_bound():
    P = csr_array(np.array([[0.0, 1.0], [0.5, 0.0]]))
    radius, _, complete = spectrum(P, Deadline.of(1e-9))
    assert not complete
    assert radius is None


def test_it_is_within_the_proved_bound():
    result, loop = loop_of(standard_map(20))
    assert loop["radius"] * loop["growth"] <= result.contraction * (1 + 1e-9)


def test_the_measure_counts_the_same_visits():
    """Without a weight the Lyapunov measure sums to the mean time, an independent way to it."""
    result, loop = loop_of(standard_map(20, gamma=1.0))
    assert loop["mean"] == pytest.approx(result.measure.sum(), rel=1e-6)


def test_a_long_decay_is_thinned():
    P = csr_array(np.array([[0.999]]))
    steps_, left, mean = decay(P, np.ones(1), EVER)
    assert len(steps_) <= 402
    assert left == pytest.approx([0.999**n for n in steps_])
    assert mean is None

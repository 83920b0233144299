"""The answer over ranks is that of one process, and its claims hold; spoiled ones do not."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from launching import needs_mpi, returned
from slab_programs import answer, solve_file
from test_compiled import without_enclosures

import lmdsl as lm
from lmdsl.certificate import judge
from lmdsl.certificate.claims import Witness
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.reading import Read, added, read
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs import compiling, judging, solving
from lmdsl.slabs.chains import peeling
from lmdsl.slabs.gamma import refusing

pytestmark = pytest.mark.long  # in other versions it would find nothing else

EXAMPLES = Path(__file__).parents[2] / "examples"
MAP = str(EXAMPLES / "standard_map.json")
# Verified: at gamma above 1 and near gamma_bar, with noise, zeros in the cost, ties.
SEEDS = [0, 1, 3, 5, 6, 13, 25]


# What is added up over ranks, in an order that depends on them.
ADDED = {"certificate": None, "mu": None}


def require_equal(one, found):
    """Require one process's answer: the policy, and the values to 12 digits."""
    cells = np.array(found["cells"])
    assert (np.flatnonzero(one.cell_status == 1) == cells).all()
    assert (one.control_index[cells] == found["control"]).all()
    value = np.array(found["V_up"])
    assert np.abs(value - one.value[cells]).max() <= 1e-12 * value.max()
    certificate = found["certificate"]
    assert certificate["verified"]
    assert certificate["cost"] == pytest.approx(one.cost, rel=1e-12)
    assert 0 <= certificate["contraction"] < 1  # which depends on how far w was swept
    assert certificate["gap"] <= 1e-6


def alike(problem, counts, gathered=10**6):
    """Require the same answer of each number of ranks, to the bit where it divides the ranges."""
    first = None
    for count in counts:
        found = as_threads(count, lambda ranks: answer(ranks, problem, gathered))
        assert all(each == found[0] for each in found)
        first = first or found[0]
        if count in (1, 2, 4):
            assert {**found[0], **ADDED} == {**first, **ADDED}
            assert found[0]["mu"] == pytest.approx(first["mu"], rel=1e-11, abs=1e-15)
        yield found[0]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_problems_are_solved_as_in_one_process(seed):
    problem = without_enclosures(seed)
    one = lm.solve(problem)
    assert one.status == "verified"
    for found in alike(problem, (1, 2, 4, 3)):
        require_equal(one, found)


def test_the_standard_map_is_solved_as_in_one_process():
    one = lm.solve(MAP)
    for found in alike(lm.load(MAP), (1, 2, 4, 7)):
        require_equal(one, found)


FEW = ("double_integrator", "henon_map", "logistic_map", "standard_map_held")
MORE = ("van_der_pol", "inverted_pendulum", "pendulum_on_cart")


@pytest.mark.parametrize(
    "name", [*FEW, *(pytest.param(name, marks=pytest.mark.long) for name in MORE)]
)
def test_shipped_systems_are_solved_as_in_one_process(name):
    problem = lm.load(EXAMPLES / f"{name}.json")
    one = lm.solve(problem)
    for count in (2, 3):
        for gathered in (10**6, 0):
            every = as_threads(count, lambda ranks, g=gathered: answer(ranks, problem, g))
            require_equal(one, every[0])


@pytest.mark.parametrize(
    ("count", "gathered", "most"),
    [
        (2, 0, 10**6),
        pytest.param(2, 0, 0, marks=pytest.mark.long),
        pytest.param(3, 10**6, 0, marks=pytest.mark.long),
    ],
)
def test_cart_and_pole_in_four_dimensions_are_solved_as_in_one_process(
    count, gathered, most, monkeypatch
):
    """Few cells along the rail, along which ranks divide them: halos are large."""
    monkeypatch.setattr(peeling, "MOST_CORE", most)
    data = lm.systems.NAMED["cart_pole"].problem
    ends = {"x": 0.6, "theta": np.pi / 4, "v": 1.5, "omega": 3}  # two cells, of eight
    changes = {
        "system": {**data["system"], "substeps": 2},
        "state_box": {name: {**axis, "cells": 8} for name, axis in data["state_box"].items()},
        "attractor": {"boxes": [{name: [-end, end] for name, end in ends.items()}]},
    }
    problem = lm.Problem.model_validate({**data, **changes})
    one = lm.solve(problem)
    assert one.coverage.share > 0.6
    require_equal(one, as_threads(count, lambda ranks: answer(ranks, problem, gathered))[0])


@pytest.mark.parametrize("most", [10**6, 0])
@pytest.mark.parametrize("seed", [*SEEDS, None])
def test_no_rank_has_to_hold_a_policy(seed, most, monkeypatch):
    """The same answers where all ranks evaluate, and rank 0 has the core, or all sweep it."""
    monkeypatch.setattr(peeling, "MOST_CORE", most)
    problem = lm.load(MAP) if seed is None else without_enclosures(seed)
    one = lm.solve(problem)
    for found in alike(problem, (1, 2, 4, 3), 0):
        require_equal(one, found)


@pytest.mark.long
@needs_mpi
@pytest.mark.parametrize("gathered", ["1000000", "0"])
def test_the_standard_map_under_mpi(gathered):
    one = lm.solve(MAP)
    found = returned(2, "solve_file", MAP, gathered, script="slab_programs.py")
    assert found[0] == found[1] == as_threads(2, lambda r: solve_file(r, MAP, gathered))[0]
    require_equal(one, found[0])


def test_one_rank_without_time_ends_the_work_of_all():
    """With the policy at hand: what holds of it is claimed, and no more."""

    def program(ranks, gathered):
        lp = compiling.compiled(ranks, lm.load(MAP))
        found = solving.solved(lp, time_up=lambda: ranks.rank == 1, gathered=gathered)
        return found.steps, found.certificate

    for gathered in (10**6, 0):
        found = as_threads(3, lambda ranks, g=gathered: program(ranks, g))
        assert found == [found[0]] * 3
        assert found[0][0] <= 1
        assert found[0][1].stabilizing
        assert found[0][1].upper_bound


def test_what_no_policy_can_do_is_not_claimed():
    """Unverified alike: at gamma < 1 the optimum stays; beyond gamma_bar no policy is found."""
    below, empty = (without_enclosures(seed) for seed in (7, 8))
    assert lm.solve(below).status == "unverified"
    for found in alike(below, (1, 2, 3)):
        assert not found["certificate"]["stabilizing"]
    assert lm.solve(empty).status == "not_stabilizable"
    assert as_threads(2, lambda ranks: answer(ranks, empty)) == [None, None]


@pytest.mark.parametrize(
    ("seed", "gathered"), [(12, 10**6), (18, 10**6), (None, 10**6), (12, 0), (None, 0)]
)
def test_beyond_gamma_bar_it_is_refused_with_a_proof(seed, gathered):
    """Which the judge of one process confirms, and which gamma below gamma_bar has not."""
    problem = lm.load(MAP).replaced(gamma=2.6) if seed is None else without_enclosures(seed)
    one, lp = lm.solve(problem), lm.compile(problem)
    assert (one.status, one.cause) == ("not_stabilizable", "gamma")
    first = None
    for count in (1, 2, 3):
        found = as_threads(count, lambda ranks: answer(ranks, problem, gathered))
        assert all(each == found[0] for each in found)
        first = first or found[0]
        assert found[0] == first  # passes of this kind are the same for any number of ranks
        assert found[0]["certificate"]["refusal"]
        assert not found[0]["certificate"]["verified"]
        w = np.array(found[0]["refusal"])
        assert judge.verdict(lp, Witness(None, refusal=w), 1e-6).refusal


def test_a_spoiled_refusal_is_none():
    def program(ranks, spoiled):
        lp = compiling.compiled(ranks, lm.load(MAP).replaced(gamma=2.6))
        w = refusing.refusal(lp, lambda: False)
        w[-1] *= 1.0 if ranks.rank == 0 else spoiled
        return judging.verdict(lp, Witness(None, refusal=w), 1e-6).refusal

    assert as_threads(2, lambda ranks: program(ranks, 1.0)) == [True] * 2
    assert as_threads(2, lambda ranks: program(ranks, 50.0)) == [False] * 2
    assert as_threads(2, lambda ranks: program(ranks, np.nan)) == [False] * 2


# The judge over ranks: what it says of right and spoiled vectors is what one process says.


def judged(spoiled, count=3):
    """The certificate over ranks of a witness that ``spoiled`` changes, and that of the whole."""
    whole = lm.compile(MAP)
    found = as_threads(1, lambda ranks: solving.solved(compiling.compiled(ranks, lm.load(MAP))))
    good = found[0].witness
    witness = spoiled(whole, good)

    def program(ranks):
        lp = compiling.compiled(ranks, lm.load(MAP))
        first, last = lp.mesh.division.own(ranks.rank)
        own = Witness(
            witness.policy[first:last] - whole.pair_pointer[first],
            *(x[first:last] for x in (witness.w, witness.V_up, witness.W, witness.mu)),
        )
        return judging.verdict(lp, own, 1e-6)

    every = as_threads(count, program)
    assert all(each == every[0] for each in every)
    return every[0], judge.verdict(whole, witness, 1e-6)


CLAIMS = ("stabilizing", "upper_bound", "lower_bound", "measure")


def at(x, k, factor):
    x = x.copy()
    x[k] *= factor
    return x


SPOILED = {
    "nothing": (lambda lp, good: good, None),
    "w": (lambda lp, good: replace(good, w=at(good.w, 900, 0.5)), "stabilizing"),
    "V_up": (lambda lp, good: replace(good, V_up=at(good.V_up, 900, 1 - 1e-9)), "upper_bound"),
    "W": (lambda lp, good: replace(good, W=at(good.W, 1700, 1 + 1e-9)), "lower_bound"),
    "mu": (lambda lp, good: replace(good, mu=at(good.mu, 10, 1.001)), "measure"),
    "negative": (lambda lp, good: replace(good, mu=at(good.mu, 10, -1.0)), "measure"),
    "nan": (lambda lp, good: replace(good, V_up=at(good.V_up, 3, np.nan)), "upper_bound"),
}


@pytest.mark.parametrize("what", SPOILED)
def test_a_spoiled_vector_is_refused_on_every_rank(what):
    spoiled, claim = SPOILED[what]
    found, whole = judged(spoiled)
    assert [getattr(found, name) for name in CLAIMS] == [getattr(whole, name) for name in CLAIMS]
    assert [name for name in CLAIMS if not getattr(found, name)] == ([claim] if claim else [])
    assert found.verified == whole.verified == (claim is None)
    assert found.contraction == whole.contraction
    for number in ("cost", "lower", "gap"):
        one = getattr(whole, number)
        assert getattr(found, number) == (one if one is None else pytest.approx(one, rel=1e-3))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_what_is_summed_over_ranks_is_rounded_outward(count):
    """Against the rationals: m'V_up from above, m'W from below, their gap from above."""
    exact = {}

    def kept(lp, good):
        m, V, W = (map(Fraction, x.tolist()) for x in (lp.weight, good.V_up, good.W))
        both = [(a * b, a * c) for a, b, c in zip(m, V, W, strict=True)]
        exact["cost"], exact["lower"] = (sum(part) for part in zip(*both, strict=True))
        return good

    found, _ = judged(kept, count)
    slack = Fraction(1, 10**13)
    assert exact["cost"] <= Fraction(found.cost) <= exact["cost"] * (1 + slack)
    assert exact["lower"] * (1 - slack) <= Fraction(found.lower) <= exact["lower"]
    gap = (exact["cost"] - exact["lower"]) / exact["cost"]
    assert gap <= Fraction(found.gap) <= gap + slack


def test_a_column_of_another_cell_is_refused():
    def other(lp, good):
        policy = good.policy.copy()
        policy[900] = lp.pair_pointer[900 + 1]
        return replace(good, policy=policy)

    found, whole = judged(other)
    assert not found.verified
    assert not whole.verified


def test_ghosts_swapped_while_it_is_solved_do_not_pass_the_judge():
    """Solved with values of cells in each other's places: noticed on the way, or not verified."""

    def program(ranks):
        lp = compiling.compiled(ranks, lm.load(MAP))
        if ranks.rank == 0:
            for slots in lp.mesh.halo.slots.values():
                slots[:] = slots[::-1].copy()
        return solving.solved(lp).certificate.verified

    with pytest.raises(RankError, match="ranks saw wrong values"):
        as_threads(2, program)


def test_a_value_comes_from_the_owner_of_its_number():
    def program(ranks):
        division = Division.cut(np.ones(20, dtype=int), ranks.count)
        first, last = division.own(ranks.rank)
        asked = np.random.default_rng(ranks.rank).integers(0, 20, 9)
        return (read(ranks, division, asked, np.arange(first, last) / 2.0) == asked / 2).all()

    assert as_threads(3, program) == [True] * 3


def test_values_that_ranks_add_to_each_other_arrive():
    def program(ranks):
        division = Division.cut(np.ones(20, dtype=int), ranks.count)
        first, last = division.own(ranks.rank)
        cells = np.setdiff1d(np.arange(20), np.arange(first, last))
        return added(ranks, division, cells, cells * 1.0, np.zeros(last - first)).tolist()

    assert np.concatenate(as_threads(3, program)).tolist() == [2.0 * k for k in range(20)]


class Confused:
    """A rank that answers for other cells than it was asked for."""

    def __init__(self, ranks):
        self.ranks = ranks

    def __getattr__(self, name):
        return getattr(self.ranks, name)

    def exchange(self, parcels, *more):
        swapped = {k: a[::-1].copy() if a.dtype == float else a for k, a in parcels.items()}
        return self.ranks.exchange(swapped, *more)


def test_an_answer_for_other_cells_is_refused():
    def program(ranks):
        division = Division.cut(np.ones(20, dtype=int), ranks.count)
        first, last = division.own(ranks.rank)
        used = Confused(ranks) if ranks.rank == 1 else ranks
        return read(used, division, np.arange(20), np.arange(first, last) / 2.0)

    with pytest.raises(RankError, match=r"answers rank [012] for other cells"):
        as_threads(3, program)


def test_a_rank_without_the_cells_is_not_asked_in_vain():
    def program(ranks):
        lp = compiling.compiled(ranks, lm.load(MAP))
        mesh = Read.again(lp.mesh)
        bounds = mesh.division.bounds.copy()
        bounds[2] += (ranks.rank == 1) * 5  # rank 1 says that it begins later
        return read(
            ranks, Division(bounds, mesh.division.firsts), np.arange(lp.mesh.division.cells),
            np.zeros(int(bounds[mesh.division.firsts[ranks.rank + 1]]
                         - bounds[mesh.division.firsts[ranks.rank]])),
        )  # fmt: skip

    with pytest.raises(RankError, match="for cells that it has not"):
        as_threads(2, program)

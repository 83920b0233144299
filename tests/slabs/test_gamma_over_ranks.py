"""Which gamma is feasible, over ranks that none holds the model: proved brackets, what is left."""

import contextlib
import functools
import itertools
from pathlib import Path

import numpy as np
import pytest
from alike import alike, answers, sampled

import lmdsl as lm
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs import compiling
from lmdsl.slabs.gamma import bracket, refusing
from lmdsl.slabs.gamma.restricting import restricted

pytestmark = pytest.mark.long  # in other versions it would find nothing else

MAP = lm.load(Path(__file__).parents[2] / "examples/standard_map.json").replaced(gamma=2.6)


@pytest.mark.parametrize(("seed", "gathered", "count"), [
    (38, 10**6, 2), (38, 0, 3), pytest.param(18, 10**6, 3, marks=pytest.mark.long),
    pytest.param(None, 10**6, 2, marks=pytest.mark.long),
    pytest.param(None, 0, 3, marks=pytest.mark.long),
])  # fmt: skip
def test_the_bracket_of_all_ranks_holds_that_of_one_process(seed, gathered, count):
    problem = MAP if seed is None else sampled(seed)
    one = lm.solve(problem)
    low, high = one.gamma_bar
    every = answers(problem, count, whole=0, gathered=gathered)
    found = every[0]
    assert (found.status, found.cause) == (one.status, one.cause)
    assert found.gamma_bar[0] <= low * (1 + 1e-6)
    assert high <= found.gamma_bar[1] * (1 + 1e-6)
    assert found.gamma_bar[1] <= found.gamma_bar[0] * 1.01
    assert found.certificate.refusal
    assert found.beyond_gamma.to_dict() == one.beyond_gamma.to_dict()
    for other in every[1:]:
        assert (other.message, other.gamma_bar) == (found.message, found.gamma_bar)


@pytest.mark.parametrize("seed", [7, 24, 33, 45, 48, 56])
def test_the_bracket_of_all_ranks_is_narrow(seed):
    """Also where gamma is raised no further, and where cells fall to nothing for ever."""
    exact = lm.gamma_max(sampled(seed))
    problem = sampled(seed).replaced(gamma=1.3 * exact.high)

    def program(ranks):
        lp = compiling.compiled(ranks, problem)
        return bracket.bracket(lp, refusing.refusal(lp, lambda: False), 0, lambda: False)

    low, high = as_threads(2, program)[0]
    assert exact.low * (1 - 1.5e-3) < low <= exact.high
    assert exact.low <= high < exact.high * (1 + 1.5e-3)


@pytest.mark.full
@pytest.mark.parametrize(("cells", "least"), [(150, 2.32), (250, 2.498)])
def test_the_bracket_of_finer_grids_is_what_docs_say(cells, least):
    """docs/distributed.md: gamma_bar is 2.5."""
    data = MAP.to_dict()
    for axis in data["state_box"].values():
        axis["cells"] = cells

    def program(ranks):
        lp = compiling.compiled(ranks, lm.Problem.model_validate(data))
        return bracket.bracket(lp, refusing.refusal(lp, lambda: False), 10**4, lambda: False)

    low, high = as_threads(2, program)[0]
    assert least <= low <= 2.5
    assert 2.5 <= high <= 2.5 * (1 + 1e-9)


@pytest.mark.parametrize("whole", [0, 10**7])
def test_what_a_gamma_leaves_is_solved(whole):
    """By all ranks, and by rank 0: 5 cells, as in one process."""
    one = alike(sampled(45), (1, 3), whole=whole, restrict_to_gamma=True)
    assert one.status == "verified"
    assert (one.cell_status == 6).any()


def test_where_a_gamma_leaves_nothing_it_is_refused():
    found = answers(sampled(38), 2, whole=0, restrict_to_gamma=True)[0]
    assert (found.status, found.cause) == ("not_stabilizable", "gamma")


def test_the_part_that_is_left_is_that_of_one_process():
    """Cells without which every other one keeps a pair, and some that leave one with none."""
    from lmdsl.optimize.feasibility.restriction import restricted as alone

    lp = lm.compile(sampled(45))
    w = lm.solve(sampled(45)).refusal_vector[lp.cells]
    expected = alone(lp, w)

    def program(ranks, w):
        own = compiling.compiled(ranks, sampled(45))
        start = sum(ranks.collect(len(own.cell_status))[: ranks.rank])
        first, last = own.mesh.division.own(ranks.rank)
        left = restricted(own, w[first:last] > 0, start)
        return left and [x.tolist() for x in (
            left.cells, left.control, left.cost, left.weight, left.cell_status,
            left.mesh.numbers[left.rows.target], left._algorithm_1[0],
        )]  # fmt: skip

    for count in (2, 3):
        found = as_threads(count, lambda ranks: program(ranks, w))
        joined = [[*itertools.chain(*parts)] for parts in zip(*found, strict=True)]
        assert joined == [x.tolist() for x in (
            expected.cells, expected.control, expected.cost, expected.weight,
            expected.cell_status, expected.rows.target, expected._algorithm_1[0],
        )]  # fmt: skip
    some = w.copy()
    some[np.flatnonzero(w == 0)[:2]] = 1.0
    kept = alone(lp, some)
    for found in as_threads(2, lambda ranks: program(ranks, some)):
        assert (found is None) == (kept is None)


@functools.cache
def exactly():
    """The bracket of one process."""
    return lm.gamma_max(sampled(18))


# Negative controls: what ranks prove of gamma_bar holds whatever vectors and plans they have.


@pytest.mark.parametrize("seed", range(2))
def test_no_vector_proves_a_high_that_is_too_low(seed):
    low = exactly().low

    def program(ranks):
        lp = compiling.compiled(ranks, sampled(18))
        random = np.random.default_rng([seed, ranks.rank])
        w = refusing.refusal(lp, lambda: False) * random.choice([0.0, 0.5, 1.0, 2.0], lp.n)
        return bracket.least_high(lp, w)

    found = as_threads(3, program)
    assert found == [found[0]] * 3
    assert found[0] >= low


def test_a_wrong_plan_proves_no_wrong_bracket():
    """Ghosts in each other's places: noticed on the way, or the bracket still holds gamma_bar."""
    exact = exactly()

    def program(ranks):
        lp = compiling.compiled(ranks, sampled(18))
        w = refusing.refusal(lp, lambda: False)
        for slots in lp.mesh.halo.slots.values():
            slots[:] = slots[::-1].copy()
        return bracket.bracket(lp, w, 0, lambda: False)

    with contextlib.suppress(RankError):
        for low, high in as_threads(2, program):
            assert low <= exact.high
            assert high >= exact.low


def test_no_policy_is_proved_beyond_gamma_bar():
    """Neither one that passes lead to, nor any other; below it theirs is."""
    exact = exactly()

    def program(ranks):
        lp = compiling.compiled(ranks, sampled(18))
        random = np.random.default_rng(ranks.rank)
        widths = np.diff(lp.pair_pointer)
        policies = [bracket.descended(lp, g * exact.low, lambda: False) for g in (0.98, 1.02)]
        policies += [lp.pair_pointer[:-1] + random.integers(0, widths) for _ in range(3)]
        return [
            [bracket.proved_at(lp, policy, g, 0, lambda: False) for policy in policies]
            for g in (0.98 * exact.low, exact.high * (1 + 1e-6))
        ]

    below, beyond = as_threads(2, program)[0]
    assert below[0]
    assert not any(beyond)


def test_a_low_is_proved_of_its_own_policy():
    def program(ranks):
        lp = compiling.compiled(ranks, sampled(18))
        steps = bracket.beginning.climbing(lp, 10**6, lambda: False)
        _, _, (at, policy, V) = itertools.islice(steps, 3)
        other = lp.pair_pointer[1:] - 1
        return [bracket.proves_low(lp, p, V, g) for p, g in
                ((policy, at), (policy, 1.1 * at), (other, at))]  # fmt: skip

    assert as_threads(2, program) == [[True, False, False]] * 2

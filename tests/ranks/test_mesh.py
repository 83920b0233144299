"""Who owns which cells: ranges by definition, ghosts by their numbers; wrong ones are refused."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from launching import needs_mpi, returned
from rank_programs import PROGRAMS, graph, own_rows, products

from lmdsl.ranks.mesh import Halo, Mesh
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone, RankError

COUNTS = [1, 2, 3, 4, 7]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 50), min_size=1, max_size=60), st.sampled_from([1, 2, 3, 4, 7, 8]))
def test_ranges_cover_all_cells_and_share_the_pairs(pairs, count):
    division = Division.cut(np.array(pairs), count)
    bounds = division.bounds.tolist()
    assert bounds[0] == 0
    assert bounds[-1] == len(pairs)
    assert bounds == sorted(bounds)
    assert len(bounds) == (5 if count in (1, 2, 4) else count + 1)
    spans = [division.own(rank) for rank in range(count)]
    assert [a for a, _ in spans[1:]] == [b for _, b in spans[:-1]]
    assert [r for rank in range(count) for r in division.own_ranges(rank)] == list(
        itertools.pairwise(bounds)
    )
    weight = np.maximum(pairs, 1)
    most = max(weight[a:b].sum() for a, b in itertools.pairwise(bounds))
    assert most <= weight.sum() / (len(bounds) - 1) + weight.max()  # no range has much more
    cells = np.arange(len(pairs))
    owner = division.owner(cells)
    assert all((owner[a:b] == rank).all() for rank, (a, b) in enumerate(spans))


def test_ranges_do_not_depend_on_the_ranks_that_divide_them():
    pairs = np.random.default_rng(3).integers(0, 9, 1000)
    bounds = [Division.cut(pairs, count).bounds.tolist() for count in (1, 2, 4)]
    assert bounds[0] == bounds[1] == bounds[2]
    for count in (3, 7):
        assert Division.cut(pairs, count).bounds.tolist() != bounds[0]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 12)), min_size=1, max_size=12),
    st.sampled_from([1, 2, 3, 4, 7]),
)
def test_cells_that_are_alike_need_not_be_told_one_by_one(runs, count):
    pairs, cells = np.array(runs).T
    one = Division.cut(np.repeat(pairs, cells), count)
    assert Division.cut(pairs, count, cells).bounds.tolist() == one.bounds.tolist()


def test_ranges_stay_together_when_cells_are_left_out():
    kept = np.random.default_rng(5).random(200) < 0.3

    def program(ranks):
        division = Division.cut(np.ones(200, dtype=int), ranks.count)
        first, last = division.own(ranks.rank)
        return division.within(ranks, kept[first:last]).bounds.tolist()

    whole = program(Alone())
    assert whole == [0, *np.cumsum([kept[50 * k : 50 * k + 50].sum() for k in range(4)])]
    for count in (2, 4):
        assert as_threads(count, program) == [whole] * count


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("seed", range(5))
def test_every_value_is_that_of_its_global_number(count, seed):
    def program(ranks):
        mesh, pointer, target, share = own_rows(ranks, seed)
        cells = mesh.division.cells
        assert (np.diff(mesh.numbers) > 0).sum() >= mesh.own - 1
        assert mesh.numbers[mesh.columns] == cells
        assert (mesh.local(mesh.numbers) == np.arange(mesh.columns + 1)).all()
        first, last = mesh.division.own(ranks.rank)
        for kind in (np.float64, np.int32, np.int64, np.uint8, np.bool_):
            of = (np.arange(cells + 1) % 2 if kind == np.bool_ else np.arange(cells + 1)).astype(
                kind
            )
            assert (mesh.spread(of[first:last], of[cells]) == of[mesh.numbers]).all()
        if count == 1:
            assert not len(mesh.ghosts)
        return mesh.numbers[target], pointer, share

    found = as_threads(count, program)
    _, whole, shares, _ = graph(seed)
    assert (np.concatenate([target for target, *_ in found]) == whole).all()  # in the same order
    assert (np.concatenate([share for *_, share in found]) == shares).all()


def whole_products():
    pointer, target, share, length = graph()
    values = [np.random.default_rng(seed).random(len(length)) for seed in range(3)]
    return [
        np.array(products(pointer, target, share, np.append(x, 0.0))).tobytes().hex()
        for x in values
    ]


@pytest.mark.parametrize("count", COUNTS)
def test_sums_over_rows_are_those_of_one_process(count):
    assert as_threads(count, PROGRAMS["rows_times_values"]) == [whole_products()] * count


@needs_mpi
@pytest.mark.parametrize("count", [2, 4])
def test_sums_over_rows_under_mpi(count):
    assert returned(count, "rows_times_values") == [whole_products()] * count


@pytest.mark.parametrize("count", [2, 3, 7])
def test_a_plan_of_some_ghosts_leaves_the_others_nan(count):
    def program(ranks):
        mesh, _, target, _ = own_rows(ranks)
        some = target[::3]
        halo = mesh.for_rows(some)
        mesh.require_covered(halo, some)
        assert halo.size == len(np.unique(some[(some >= mesh.own) & (some < mesh.columns)]))
        x = mesh.spread(mesh.numbers[: mesh.own].astype(float), np.inf, halo)
        known = np.isin(np.arange(mesh.columns), some) | (np.arange(mesh.columns) < mesh.own)
        assert (x[:-1][known] == mesh.numbers[:-1][known]).all()
        assert np.isnan(x[:-1][~known]).all()
        return int((~known).sum())

    assert sum(as_threads(count, program)) > 0


@pytest.mark.parametrize("count", COUNTS)
def test_plans_by_kind_carry_values_once_and_back(count):
    def program(ranks):
        mesh, *_ = own_rows(ranks)
        kind = mesh.spread((mesh.numbers[: mesh.own] % 4).astype(np.uint16), 0)
        parts = mesh.halo.parted(kind, 3)
        x = np.full(mesh.columns + 1, np.nan)
        x[: mesh.own], x[-1] = mesh.numbers[: mesh.own], mesh.numbers[-1]
        for k, part in enumerate(parts):
            part.fill(x)
            known = (kind <= k) | (np.arange(mesh.columns + 1) < mesh.own)
            known[-1] = True
            assert (np.isnan(x) == ~known).all()
        assert (x == mesh.numbers).all()
        sums = np.ones(mesh.columns + 1)
        for part in parts:
            part.add(sums)
        times = np.ones(mesh.own)
        for cells in mesh.halo.send.values():
            times[cells] += 1
        assert (sums[: mesh.own] == times).all()

    as_threads(count, program)


def test_values_of_another_part_of_a_plan_are_refused():
    def program(ranks):
        mesh, *_ = own_rows(ranks)
        kind = np.zeros(mesh.columns, dtype=np.uint16)
        parts = mesh.halo.parted(kind, 1)
        mine = parts[0] if ranks.rank else mesh.halo
        mine.fill(np.zeros(mesh.columns + 1))

    with pytest.raises(RankError, match="values of another time or plan"):
        as_threads(3, program)


# Negative controls: what a wrong plan would do to the answer, no claim sees.


def spoil(spoiled, use=lambda mesh: mesh.confirm(mesh.halo, np.arange(mesh.own, mesh.columns))):
    """Let rank 1 of 3 spoil its mesh, then all use it; what is refused is raised."""

    def program(ranks):
        mesh, *_ = own_rows(ranks)
        if ranks.rank == 1:
            spoiled(mesh)
        use(mesh)

    as_threads(3, program)


def test_an_untouched_plan_is_confirmed():
    spoil(lambda mesh: None)


def test_two_ghosts_swapped_where_they_come_are_refused():
    def swap(mesh):
        slots = next(iter(mesh.halo.slots.values()))
        slots[[0, 1]] = slots[[1, 0]]

    with pytest.raises(RankError, match=r"rank 1 waits for cell \d+ and gets \d+"):
        spoil(swap)


def test_two_cells_swapped_where_they_are_sent_are_refused():
    def swap(mesh):
        cells = next(iter(mesh.halo.send.values()))
        cells[[0, 1]] = cells[[1, 0]]

    with pytest.raises(RankError, match=r"rank [02] waits for cell \d+ and gets \d+"):
        spoil(swap)


def test_ghosts_numbered_in_another_order_are_refused():
    def swap(mesh):
        mesh.ghosts[[0, 1]] = mesh.ghosts[[1, 0]]

    with pytest.raises(RankError, match="waits for cell"):
        spoil(swap)
    with pytest.raises(RankError, match="has no ghost for"):
        spoil(swap, lambda mesh: mesh.local(np.sort(mesh.ghosts)))


def test_a_halo_one_cell_short_is_refused():
    def short(mesh):
        of = max(mesh.halo.send, key=lambda k: len(mesh.halo.send[k]))
        mesh.halo.send[of] = mesh.halo.send[of][:-1]

    with pytest.raises(RankError, match=r"rank [02] expects \d+ numbers of rank 1, and got"):
        spoil(short, lambda mesh: mesh.spread(np.zeros(mesh.own)))

    def shorter(mesh):
        for plan in (mesh.halo.send, mesh.halo.slots):
            for other in plan:
                plan[other] = plan[other][:-1]

    def both_ends(mesh):  # agreed by sender and receiver: sizes do not tell
        shorter(mesh)
        mesh.confirm(mesh.halo, np.arange(mesh.own, mesh.columns))

    with pytest.raises(RankError, match="gets nothing"):
        spoil(lambda mesh: None, both_ends)

    def short_plan(mesh):
        halo = mesh.plan(np.arange(len(mesh.ghosts) - 1))
        mesh.require_covered(halo, np.arange(mesh.columns + 1))

    with pytest.raises(RankError, match=r"reads cell \d+, which nobody sends"):
        spoil(lambda mesh: None, short_plan)


class Replaying:
    """A rank that sends what it sent at first, again and again."""

    def __init__(self, ranks):
        self.ranks, self.first = ranks, None

    def __getattr__(self, name):
        return getattr(self.ranks, name)

    def exchange(self, parcels, expected=None, kind=np.float64):
        self.first = self.first or parcels
        return self.ranks.exchange(self.first, expected, kind)


def test_stale_values_are_refused():
    def replay(mesh):
        mesh.halo.ranks = Replaying(mesh.ranks)

    def use(mesh):
        for k in range(2):
            mesh.spread(np.full(mesh.own, float(k)))

    with pytest.raises(RankError, match=r"rank 1 sent rank [02] values of another time or plan"):
        spoil(replay, use)
    spoil(lambda mesh: None, use)


def test_values_of_another_plan_are_refused():
    def other(mesh):
        halo = mesh.halo
        mesh.halo = Halo(halo.ranks, halo.number + 1, halo.send, halo.slots, halo.spreads)

    with pytest.raises(RankError, match="values of another time or plan"):
        spoil(other, lambda mesh: mesh.spread(np.zeros(mesh.own)))


class Lying(Division):
    """Says that rank 1 begins in the middle of its cells."""

    def own(self, rank):
        first, last = super().own(rank)
        return ((first + last) // 2 if rank == 1 else first), last


def test_a_rank_that_lies_about_its_range_is_refused():
    _, target, _, length = graph()

    def division(ranks):
        found = Division.cut(length, ranks.count)
        return Lying(found.bounds, found.firsts) if ranks.rank == 1 else found

    with pytest.raises(RankError, match=r"rank 1 says that cells \d+ to \d+ are its own"):
        as_threads(3, lambda ranks: Mesh.of(ranks, division(ranks), target))

    def unasked(mesh):  # it begins to lie once all have agreed
        mesh.division = Lying(mesh.division.bounds, mesh.division.firsts)

    with pytest.raises(RankError, match=r"rank [02] asks rank 1, which has the cells"):
        spoil(unasked, lambda mesh: mesh.plan(np.arange(len(mesh.ghosts))))


def test_ranks_that_divide_cells_differently_are_refused():
    def program(ranks):
        Division.cut(np.ones(40 + (ranks.rank == 2), dtype=int), ranks.count).confirm(ranks)

    with pytest.raises(RankError, match="divides the cells unlike"):
        as_threads(3, program)


def test_cells_outside_are_refused():
    with pytest.raises(RankError, match=r"outside 0\.\.9"):
        Mesh.of(Alone(), Division.cut(np.ones(10, dtype=int), 1), np.array([-1, 3]))
    mesh = Mesh.of(Alone(), Division.cut(np.ones(10, dtype=int), 1), np.array([3]))
    with pytest.raises(RankError, match="has no ghost"):
        mesh.local(np.array([11]))

"""Systems over ranks against linear algebra, and to the same bits for 1, 2 and 4 ranks."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from lmdsl.common.types import never
from lmdsl.optimize.linear.gauss_seidel import SplitMatrix
from lmdsl.optimize.linear.substitution import Peeled
from lmdsl.ranks.mesh import Mesh
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone, RankError
from lmdsl.slabs.chains import peeling
from lmdsl.slabs.chains.peeling import SpreadPeeled
from lmdsl.slabs.chains.sweeping import SpreadSystem

pytestmark = pytest.mark.long  # in other versions it would find nothing else

SHAPE = (12, 10)


def matrix(seed, radius, cells=120):
    """A sparse M >= 0 of a spectral radius, with entries near the diagonal and far from it."""
    random = np.random.default_rng(seed)
    M = random.random((cells, cells)) * (random.random((cells, cells)) < 0.03)
    M[np.arange(cells), (np.arange(cells) + 1) % cells] += 0.5
    M[random.random(cells) < 0.1] = 0.0
    return M * (radius / np.abs(np.linalg.eigvals(M)).max())


def spread(ranks, M):
    """The mesh of a rank, its rows, and which cells are its own."""
    division = Division.cut((M > 0).sum(axis=1), ranks.count)
    first, last = division.own(ranks.rank)
    rows = csr_array(M[first:last])
    mesh = Mesh.of(ranks, division, rows.indices)
    size = (last - first, mesh.columns)
    own = SplitMatrix.of(csr_array((rows.data, mesh.local(rows.indices), rows.indptr), shape=size))
    return mesh, own, slice(first, last)


def solved(count, M, b, what):
    """What all ranks find, one after the other; None where there is no solution."""

    def program(ranks):
        mesh, rows, own = spread(ranks, M)
        cells = np.arange(120)[own]
        if what.startswith("peeled"):
            chain = SpreadPeeled.of(mesh, rows, cells, SHAPE)
            if what == "peeled":
                return chain.solve(b[own], b[own].copy(), never)
            return chain.solve_transposed(b[own], never, 0.0)
        system = SpreadSystem.of(mesh, rows, cells, SHAPE)
        if what == "transposed":
            system = system.transposed(cells, SHAPE)
        if what == "krylov":
            return system.krylov(b[own], b[own].copy(), never)
        return system.solve(b[own], b[own].copy(), never)

    found = as_threads(count, program)
    return None if found[0] is None else np.concatenate(found)


@pytest.fixture(params=[10**6, 0], ids=["rank 0 has the core", "all sweep the core"])
def most(request, monkeypatch):
    """The number of cells of a core up to which rank 0 solves it."""
    monkeypatch.setattr(peeling, "MOST_CORE", request.param)


@pytest.mark.usefixtures("most")
@pytest.mark.parametrize("what", ["solve", "transposed", "krylov", "peeled", "peeled, transposed"])
@pytest.mark.parametrize(("seed", "radius"), [(0, 0.5), (1, 0.9), (2, 0.999)])
def test_systems_are_solved(seed, radius, what):
    M = matrix(seed, radius)
    b = np.random.default_rng(seed).random(120)
    if what.startswith("peeled"):
        M[:, 100:] = 0.0  # nobody leads to the last cells: outside the core
    exact = np.linalg.solve(np.eye(120) - (M.T if what.endswith("transposed") else M), b)
    first = solved(1, M, b, what)
    tolerance = 1e-8 if what == "krylov" else 1e-11
    for count in (1, 2, 3, 4, 7):
        found = solved(count, M, b, what)
        assert np.abs(found / exact - 1).max() <= tolerance
        if count in (1, 2, 4) and what != "peeled, transposed":  # which ranks add up
            assert found.tobytes() == first.tobytes()


def grown(ways, cells=120):
    """A forest that leads to a cycle: entries of every cell but the first three go down."""
    random = np.random.default_rng(ways)
    M = np.zeros((cells, cells))
    M[[0, 1, 2], [1, 2, 0]] = 0.9
    for i in range(3, cells):
        M[i, random.integers(max(0, i - ways), i, 2)] = 0.4
        M[i, random.integers(0, i)] = 0.1
    return M


def require_rounds(chain):
    """Require that cells lead to later own ones, and to those of later rounds, or the core."""
    place = np.full(chain.mesh.columns, len(chain.order))
    place[chain.order] = np.arange(len(chain.order))
    kind = np.full(chain.mesh.columns, len(chain.ends), dtype=np.uint16)
    kind[chain.order] = np.searchsorted(chain.ends, np.arange(len(chain.order)), side="right")
    for k, crossing in enumerate(chain.crossing):
        assert all((kind[cells] == k).all() for cells in crossing.send.values())
        for slots in crossing.slots.values():
            kind[slots] = k
    system, own = chain.system, chain.mesh.own
    for i in chain.order:
        named = system.indices[system.begin[i] : system.end[i]]
        assert (place[named] > place[i]).all() or (named >= own).any()
        assert (kind[named[named >= own]] > kind[i]).all()
        assert (place[named[named < own]] > place[i]).all()


@pytest.mark.usefixtures("most")
@pytest.mark.parametrize("count", [1, 2, 3, 7])
@pytest.mark.parametrize("ways", [1, 4, 60])
def test_the_core_is_that_of_one_process(count, ways):
    """However often ways cross from rank to rank."""
    shuffled = np.random.default_rng(ways).permutation(120)
    M, b = grown(ways)[np.ix_(shuffled, shuffled)], np.linspace(1, 2, 120)
    one = Peeled.of(SplitMatrix.of(csr_array(M)))

    def program(ranks):
        mesh, rows, own = spread(ranks, M)
        chain = SpreadPeeled.of(mesh, rows, np.arange(120)[own], SHAPE)
        require_rounds(chain)
        return np.arange(120)[own][chain.core]

    core = np.concatenate(as_threads(count, program))
    assert core.tolist() == one.core.tolist()
    assert (np.sort(shuffled[core]) < 3).all()
    for what, exact in (("peeled", M), ("peeled, transposed", M.T)):
        found = solved(count, M, b, what)
        assert np.abs(found / np.linalg.solve(np.eye(120) - exact, b) - 1).max() < 1e-12


def test_outside_the_core_there_may_be_no_solution():
    M = grown(1)
    M[50, 50] = 1.0
    for what in ("peeled", "peeled, transposed"):
        for count in (1, 3):
            assert solved(count, M, np.ones(120), what) is None


def test_what_leads_to_nothing_is_exactly_nothing():
    M = np.diag(np.full(119, 0.5), 1)  # a line: cells before the 60th lead to it
    b = np.where(np.arange(120) == 60, 1.0, 0.0)
    for count in (1, 3):
        found = solved(count, M, b, "solve")
        assert (found[61:] == 0).all()
        assert found[:61] == pytest.approx(0.5 ** (60.0 - np.arange(61)), rel=1e-12)


@pytest.mark.parametrize("count", [1, 3])
def test_where_there_is_no_solution_none_is_found(count):
    assert solved(count, matrix(3, 1.2), np.ones(120), "solve") is None


def test_cells_of_which_nobody_can_tell_are_refused():
    halo = peeling.Halo(Alone(), 1, {1: np.array([4, 7])}, {1: np.array([9, 12])})
    lost, place = np.array([12], dtype=np.uint32), peeling._places(halo, 20)
    assert peeling._news(halo, lost, place)[1].tolist() == [1]
    ways = np.ones(20, dtype=np.uint32)
    assert peeling._freed(halo, {1: np.array([1], dtype=np.uint32)}, ways).tolist() == [7]
    with pytest.raises(RankError, match="rank 1 tells of cells that rank 0 has not"):
        peeling._freed(halo, {1: np.array([2], dtype=np.uint32)}, ways)
    with pytest.raises(RankError, match="rank 2 tells of cells that rank 0 has not"):
        peeling._freed(halo, {2: np.array([0], dtype=np.uint32)}, ways)

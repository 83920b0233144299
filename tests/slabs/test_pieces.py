"""The sets of cells that ranks make piece by piece are those of one process, and only where met."""

import resource
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made
from random_problems import random_problem

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly import sampler
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.room import free_room
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.local_control import HoldControl
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone
from lmdsl.slabs import compiling
from lmdsl.slabs.digest import of_model
from lmdsl.slabs.graph import pieces
from lmdsl.slabs.graph.pairs import assembled
from lmdsl.slabs.graph.pieces import PieceSets, first_unknown, touch
from lmdsl.slabs.graph.planes import untouched

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def small_pieces(monkeypatch):
    """Pieces of few cells, few of them made at a time."""
    monkeypatch.setattr(pieces, "PIECE", 8)
    monkeypatch.setattr(pieces, "AT_ONCE", 3)
    monkeypatch.setattr(pieces, "PART", 8)


def declared(**changes):
    """A problem with sets of every kind, two axes, one a circle."""
    sets = {
        "attractor": {"points": [[0.5, 0.5]], "boxes": [{"x": [0.1, 0.35], "y": [0.0, 0.2]}],
                      "cells": [[0, 0], [12, 8]], "where": "x + y > 1.7"},
        "avoid": {"boxes": [{"x": [0.4, 0.45]}], "where": ["y > 0.55 and y < 0.6 and x < 0.3"]},
        "measure": {"density": "1 + x*y", "boxes": [{"y": [0.0, 0.9]}], "where": "x > 0.6"},
    }  # fmt: skip
    axes = {
        "x": {"low": 0.0, "high": 1.0, "cells": 13},
        "y": {"low": 0.0, "high": 1.0, "cells": 9, "periodic": True},
    }
    data = {"format": "lmdsl/1", "system": {"kind": "map", "next": {"x": "x", "y": "y"}},
            "state_box": axes, "control_grid": {"u": {"values": [0.0]}}, "stage_cost": "1",
            "sampling": {"kind": "grid", "per_axis": 2},
            **sets, **changes}  # fmt: skip
    return made({key: value for key, value in data.items() if value is not None})


def over(count, problem):
    """What each of some ranks says of all cells, in an odd order."""
    partition = Partition.of(problem)

    def program(ranks):
        sets = PieceSets.over(ranks, problem, partition, Deadline())
        mixed = np.random.default_rng(ranks.rank).permutation(partition.size)
        for some in np.array_split(mixed, 5):
            sets.meet(np.append(some.astype(float), np.nan))
        return {"number": sets.number, "free": sets.free[:], "attractor": sets.attractor[:],
                "avoid": sets.avoid[:], "mass": sets.mass[:]}  # fmt: skip

    return as_threads(count, program)


def same(count, problem):
    whole = CellSets.of(problem, Partition.of(problem))
    for found in over(count, problem):
        for name, values in found.items():
            assert values.tobytes() == np.ascontiguousarray(getattr(whole, name)).tobytes(), name


@pytest.mark.parametrize("count", [1, 2, 5])
def test_pieces_are_the_sets_of_one_process(small_pieces, count):
    same(count, declared())
    same(count, declared(measure={"weights": np.linspace(0, 1, 13 * 9).tolist()}, avoid=None))


@pytest.mark.parametrize("seed", range(12))
def test_pieces_of_random_problems(small_pieces, seed):
    problem = lm.Problem.model_validate(random_problem(np.random.default_rng(seed)))
    if not isinstance(problem.local_controller, HoldControl):
        same(3, problem)


def test_free_cells_are_found_by_their_positions(small_pieces):
    problem = declared()
    partition = Partition.of(problem)
    free = CellSets.of(problem, partition).free
    for at in (np.array([5, 0, 77, 5]), slice(3, 40), slice(30, 30), 11, slice(0, len(free))):
        sets = PieceSets.over(Alone(), problem, partition, Deadline())
        assert len(sets.free) == len(free)
        np.testing.assert_array_equal(sets.free[at], free[at])
        cell = int(np.ravel(at)[0]) if isinstance(at, np.ndarray) else partition.size
        assert sets.free_before(cell) == np.searchsorted(free, cell)


@pytest.mark.parametrize("piece", [1, 4, 2**10])
def test_runs_of_free_cells_are_found_too(monkeypatch, piece):
    monkeypatch.setattr(pieces, "PIECE", piece)
    problem = drift()
    expected = CellSets.of(problem, Partition.of(problem)).free
    rng = np.random.default_rng(piece)
    for _ in range(20):  # each time anew, so that no piece is known
        free = PieceSets.over(Alone(), problem, Partition.of(problem), Deadline()).free
        first, last = sorted(rng.integers(-len(expected), len(expected) + 9, 2).tolist())
        for at in (slice(first, last), slice(first, last, 3), slice(None), slice(last, first)):
            np.testing.assert_array_equal(free[at], expected[at])
        some = np.unique(rng.integers(0, len(expected), 5))
        np.testing.assert_array_equal(free[some], expected[some])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"avoid": {"boxes": [{"x": [0.1, 0.4]}]}}, "both attractor and avoid"),
        ({"attractor": {"boxes": [{"x": [0.01, 0.02]}]}}, "holds no whole cell"),
        ({"attractor": {"where": "x > 2"}}, "no cell as a whole"),
        ({"attractor": {"cells": [[13, 0]]}}, "index 13 is outside"),
        ({"attractor": {"points": [[3.0, 0.5]]}}, "outside the axis"),
        ({"measure": {"density": "x - 0.5"}}, "must be finite and >= 0"),
        ({"measure": {"density": "0"}}, "no cell carries weight"),
        ({"measure": {"boxes": [{"x": [0.01, 0.02]}]}}, "holds no whole cell"),
        ({"measure": {"weights": [1.0]}}, "1 weights for 117 cells"),
    ],
)
@pytest.mark.parametrize("count", [1, 3])
def test_what_is_refused_is_refused_alike(small_pieces, count, changes, said):
    problem = declared(**changes)
    with pytest.raises(lm.BadInput) as alone:
        CellSets.of(problem, Partition.of(problem))
    with pytest.raises(lm.BadInput) as together:
        over(count, problem)
    assert said in str(alone.value)
    assert str(together.value) == str(alone.value)


def drift(cells=64, **changes):
    """A slow system: a step leads one cell further on x, and stays on y."""
    axes = {name: {"low": 0.0, "high": 1.0, "cells": cells} for name in ("x", "y")}
    step = {"x": f"x + {1 / cells}*u", "y": "y"}
    return declared(state_box=axes, system={"kind": "map", "next": step}, avoid=None, measure=None,
                    control_grid={"u": {"values": [0.0, 1.0]}},
                    attractor={"boxes": [{"x": [1 - 1 / cells, 1.0]}]}, **changes)  # fmt: skip


@pytest.mark.parametrize("count", [2, 4, 8])
def test_a_rank_knows_its_own_cells_and_those_that_it_meets(monkeypatch, count):
    """Of a slow system: its planes, and one more at an end; nothing of the rest of the box."""
    monkeypatch.setattr(pieces, "PIECE", 16)
    monkeypatch.setattr(sampler, "CHUNK", 2**7)
    problem = drift()
    partition = Partition.of(problem)

    def program(ranks):
        found = assembled(ranks, problem, partition)
        return found.sets.pieces.known.sum() * 16, found.mesh.own

    for known, own in as_threads(count, program):
        assert own <= known <= own + 3 * 64  # the plane after, and ends of pieces


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads memory from /proc")
def test_untouched_pieces_take_no_memory():
    """A gigabyte of addresses, a page of each megabyte of which is written to."""

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    before = resident()
    array = untouched(2**28, np.int32)
    array[:: 2**18] = 7
    assert array[2**18] == 7
    assert array[1] == array[-1] == 0
    assert resident() - before < 2**26


def test_cells_are_met_wherever_they_stand():
    known, wanted = np.array([True, False, False, False]), np.zeros(4, dtype=bool)
    assert first_unknown(np.array([np.nan, 0.0, 3.0]), 2, known) == 3
    assert first_unknown(np.array([np.nan, 0.0, 11.0, 4.0]), 2, known) == 2
    touch(np.array([np.nan, 0.0, 11.0, 12.0, 8.0]), 2, known, wanted)
    assert wanted.tolist() == [False, False, True, True]


def crossing():
    """A step leads 164 cells on, and some ways lead through two of avoid, or end in A."""
    return declared(
        state_box={"x": {"low": 0.0, "high": 1.0, "cells": 1024}},
        system={"kind": "ode", "derivative": {"x": "1 + 0*u"}, "step": 0.16, "substeps": 1},
        attractor={"boxes": [{"x": [0.75, 0.78125]}]},
        avoid={"boxes": [{"x": [513 / 1024, 515 / 1024]}]}, measure=None,  # of the second rank
    )  # fmt: skip


@pytest.mark.parametrize("hook", ["meet", "meet_paths"])
def test_cells_that_are_not_made_known_are_found_out(monkeypatch, hook):
    """Negative control: what is looked at unknown makes another model, or none."""
    monkeypatch.setattr(pieces, "PIECE", 1)
    monkeypatch.setattr(sampler, "CHUNK", 2**6)
    problem = drift() if hook == "meet" else crossing()
    whole = lm.compile(problem)
    assert whole.n
    assert hook == "meet" or (whole.cell_status == CellStatus.ESCAPES).sum() > 100

    def program(ranks):
        return of_model(ranks, compiling.compiled(ranks, problem))

    assert as_threads(2, program) == [of_model(Alone(), whole)] * 2
    monkeypatch.setattr(PieceSets, hook, lambda *_: None)
    try:
        found = as_threads(2, program)
    except lm.LmdslError:
        return
    assert found != [of_model(Alone(), whole)] * 2


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_room_of_planes_is_that_of_the_box(data):
    """Whatever planes are asked for, in whatever order, on lines and circles."""
    n, m = data.draw(st.integers(1, 40)), data.draw(st.integers(1, 9))
    circles = data.draw(st.tuples(st.booleans(), st.booleans()))
    seed = data.draw(st.integers(0, 2**20))
    rng = np.random.default_rng(seed)
    taken = rng.random((n, m)) < data.draw(st.sampled_from([0.0, 0.01, 0.1]))
    cells = [[int(i), int(j)] for i, j in np.argwhere(taken)]
    axes = {
        name: {"low": 0.0, "high": 1.0, "cells": count, "periodic": circle}
        for name, count, circle in zip("xy", (n, m), circles, strict=True)
    }
    problem = declared(state_box=axes, attractor={"cells": cells}, discount=0.9,
                       avoid=None, measure=None)  # fmt: skip
    partition = Partition.of(problem)
    whole = free_room(~taken, partition.periodic).reshape(n, m)
    sets = PieceSets.over(Alone(), problem, partition, Deadline())
    for _ in range(3):
        planes = rng.integers(0, n, size=rng.integers(1, 4))
        sets.planes.make(planes)
        np.testing.assert_array_equal(sets.planes.room.reshape(n, m)[planes], whole[planes])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_all_planes_that_an_arc_crosses_are_known(data):
    """Cubic Hermite arcs, looked at in a thousand places."""
    circle = data.draw(st.booleans())
    axes = {"x": {"low": 0.0, "high": 1.0, "cells": 50, "periodic": circle}}
    problem = declared(state_box=axes, system={"kind": "map", "next": {"x": "x"}},
                       attractor={"cells": [[0]]}, avoid=None, measure=None)  # fmt: skip
    partition = Partition.of(problem)
    sets = PieceSets.over(Alone(), problem, partition, Deadline())
    places = st.floats(-0.3, 1.3)
    a, b = data.draw(places), data.draw(places)
    m, k = (data.draw(st.floats(-1.0, 1.0)) for _ in range(2))
    sets.meet_paths(np.array([[a], [b]]), np.array([[m], [k]]))
    t = np.linspace(0, 1, 1001)
    r = 1 - t
    x = r * a + t * b + t * r * (r * (m - (b - a)) - t * (k - (b - a)))
    index = partition.index([x])
    met = np.unique(index[index >= 0]).astype(int)
    assert sets.planes._known[met].all()
    if not circle and min(x.min(), a) > -0.3 and x.max() < 0.5:
        assert not sets.planes._known[40:].any()


def test_marks_of_cells_are_not_taken_for_numbers():
    sets = PieceSets.over(Alone(), drift(), Partition.of(drift()), Deadline())
    assert sets.attractor[np.array([0, 64 * 64 - 1])].tolist() == [False, True]
    with pytest.raises(TypeError, match="bool"):
        sets.attractor[np.zeros(64 * 64, dtype=bool)]


def test_density_and_weights_are_read_by_cells():
    problem = declared()
    partition = Partition.of(problem)
    whole = CellSets.of(problem, partition).mass
    sets = PieceSets.over(Alone(), problem, partition, Deadline())
    cells = np.array([0, 3, 50, 116])
    assert sets.mass[cells].tobytes() == whole[cells].tobytes()
    assert sets.mass[7] == whole[7]


@pytest.mark.parametrize("local", [{"kind": "hold"}, {"kind": "hold", "partial": True}])
def test_of_cells_that_hold_a_rank_knows_the_attractor_alone(monkeypatch, local):
    """Beside its own: among all sets that it makes on the way, none of the whole box."""
    monkeypatch.setattr(pieces, "PIECE", 16)
    monkeypatch.setattr(sampler, "CHUNK", 2**6)
    made_of = pieces.BoxPieces.of
    problem = drift(local_controller=local)

    def program(ranks):
        return assembled(ranks, problem, Partition.of(problem)), ranks.rank

    every = []

    def noted(ranks, *rest):
        every.append((ranks.rank, made_of(ranks, *rest)))
        return every[-1][1]

    monkeypatch.setattr(pieces.BoxPieces, "of", noted)
    for found, rank in as_threads(4, program):
        known = [each.known.sum() * 16 for whose, each in every if whose == rank]
        assert len(known) == (3 if "partial" in local else 4)  # declared, inner, way, compiled
        assert max(known) <= found.mesh.own + 3 * 64
        index = found.hold.on(0, 64 * 64).reshape(64, 64)
        assert (index[-1] == 0).all()
        assert (index[:-1] == -1).all()

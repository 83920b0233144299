"""Along which axis slabs need the fewest cells of others: closed forms, counts, ranks."""

import sys
from pathlib import Path

import numpy as np
import pytest
from alike import answers
from problems import made, standard_map, steps

import lmdsl as lm
from benchmarks import halos
from benchmarks.halos import counted
from lmdsl.model.grid.partition import Partition
from lmdsl.ranks.threaded import as_threads
from lmdsl.slabs.compiling import compiled, local
from lmdsl.slabs.graph import cuts, looking

EXAMPLES = Path(__file__).parents[2] / "examples"
SHIFT = 3


def grid(shape, periodic=()):
    axes = np.array(shape)
    names = tuple("xyzv"[: len(axes)])
    round_ = np.isin(np.arange(len(axes)), periodic)
    return Partition(names, np.zeros(len(axes)), np.ones(len(axes)), 1 / axes, axes, round_)


def shifted(cells=(24, 12), by=SHIFT):
    """x+ = x + by cells, y+ = y, until the last columns, which are the attractor."""
    n, m = cells
    return made({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": f"x + {by}", "y": "y"}},
        "state_box": {"x": {"low": 0, "high": n + by, "cells": n + by},
                      "y": {"low": 0, "high": m, "cells": m}},
        "attractor": {"boxes": [{"x": [n, n + by]}]},
        "stage_cost": "1", "control_grid": {}, "sampling": {"kind": "grid", "per_axis": 1},
    })  # fmt: skip


def all_cells(partition, rows):
    """Every cell looked at, and where it leads."""
    N = partition.size
    source = np.repeat(np.arange(N), [len(row) for row in rows])
    every = np.arange(N)
    target = np.concatenate(rows).astype(np.int64)
    return cuts.Blocks.of(partition, N), cuts.Looked(every, np.ones_like(every), source, target)


@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_a_shift_along_one_axis(count):
    """Of every cut as many planes are known as the shift has, but for those of the attractor."""
    problem = shifted()
    lp = local(lm.compile(problem))
    assert lp.n == 288
    found = looking.estimated(lp, count)
    assert found == {"x": pytest.approx((count - 1) * SHIFT / 24), "y": 0}
    assert counted(lp, count) == pytest.approx(found)


def test_of_many_controls_those_that_lead_far_are_looked_at(monkeypatch):
    """Of 101 that move it by at most 5 cells four are taken, the first and the last among them."""
    monkeypatch.setattr(looking, "MOST_PAIRS", 4)
    far = shifted().replaced(
        control_grid={"u": {"low": 1, "high": 5, "points": 101}},
        system={"kind": "map", "next": {"x": "x + u", "y": "y"}},
    )
    lp = local(lm.compile(far))
    assert lp.pair_pointer[1] == 101
    assert looking.estimated(lp, 2) == {"x": pytest.approx(5 / 24), "y": 0}


def test_the_table_of_the_benchmark(monkeypatch, capsys, tmp_path):
    """Counted, and told by some cells."""
    shifted().save(tmp_path / "shift.json")
    monkeypatch.setattr(sys, "argv", ["halos", str(tmp_path / "shift.json")])
    assert halos.main() == 0
    told = capsys.readouterr().out.splitlines()[-1]
    assert told.startswith("| shift | 288 | x 0.12 (0.12) y 0.00 (0.00) | x 0.38 (0.38) y 0.00 (")


def test_a_shift_of_very_many_cells_of_which_few_are_looked_at():
    """Sampling is exact where all blocks move alike, however thin what they move is."""
    lp = local(lm.compile(shifted((600, 500))))
    assert looking.estimated(lp, 4)["x"] == pytest.approx(3 * SHIFT / 600, rel=0.05)
    assert looking.estimated(lp, 4)["y"] == 0


@pytest.mark.parametrize(("by", "cells"), [(1, 1), (5, 5), (12, 12), (19, 5), (24, 0)])
def test_a_shift_round_a_circle(by, cells):
    """Two slabs of 12 planes: the other one is at most all there is."""
    partition = grid((24, 6), periodic=[0])
    at = np.arange(partition.size)
    rows = [[cell] for cell in (at // 6 + by) % 24 * 6 + at % 6]
    found = cuts.ghosts(*all_cells(partition, rows), 2)
    assert found == {"x": pytest.approx(2 * 6 * cells / 144), "y": 0}


def by_planes(partition, rows, k, count):
    """Ghosts of slabs of whole planes, as sets."""
    n, plane = partition.shape[k], np.unravel_index(np.arange(partition.size), partition.shape)[k]
    whose = np.searchsorted(np.rint(np.arange(1, count) * n / count), plane, side="right")
    own = [set(), *(set() for _ in range(count - 1))]
    for cell, row in enumerate(rows):
        own[whose[cell]] |= {j for j in row if whose[j] != whose[cell]}
    return sum(map(len, own)) / partition.size


@pytest.mark.parametrize("shape", [(8, 12), (4, 8, 6), (8, 4, 4, 4)])
def test_where_all_cells_are_looked_at_ghosts_are_counted(shape):
    random = np.random.default_rng(len(shape))
    partition = grid(shape, periodic=[1])
    rows = [random.integers(partition.size, size=random.integers(1, 5))
            for _ in range(partition.size)]  # fmt: skip
    near = [[(cell + 1) % partition.size, cell] for cell in range(partition.size)]
    for some in (rows, near):
        for count in (2, 4):
            found = cuts.ghosts(*all_cells(partition, some), count)
            for k, name in enumerate(partition.names):
                assert found[name] == pytest.approx(by_planes(partition, some, k, count))


def test_only_cells_of_C_are_counted():
    """Of targets across the cut those in blocks whose middle is not in C are none."""
    partition = grid((4, 4))
    blocks, looked = all_cells(partition, [[j] for j in np.arange(16)[::-1]])
    inside = np.setdiff1d(np.arange(16), [15, 0])
    kept = [x[inside] for x in looked[:2]]
    source = np.arange(len(inside))
    found = cuts.ghosts(blocks, cuts.Looked(*kept, source, 15 - inside), 2)
    assert found == {"x": 1, "y": 1}
    assert cuts.ghosts(blocks, cuts.Looked(*kept, source, np.full(14, 15)), 2) == {"x": 0, "y": 0}


def test_slabs_have_about_equal_numbers_of_pairs():
    partition = grid((10, 2))
    blocks, looked = all_cells(partition, [[cell] for cell in range(20)])
    heavy = looked._replace(pairs=np.where(np.arange(20) < 4, 9, 1))
    along = cuts._Along(blocks, heavy, blocks.volume(looked.block), 0)
    assert along.cuts(heavy.pairs, 2).tolist() == [0, 1, 10]
    assert along.cuts(looked.pairs, 2).tolist() == [0, 5, 10]


def test_axes_with_fewer_planes_than_slabs_are_left_out():
    partition = grid((12, 5, 6))
    blocks, looked = all_cells(partition, [[cell] for cell in range(360)])
    assert [[*cuts.ghosts(blocks, looked, count)] for count in (5, 6, 12, 13)] == [
        ["x", "y", "z"], ["x", "z"], ["x"], [],
    ]  # fmt: skip


@pytest.mark.parametrize("count", [2, 16, 17, 4000])
def test_of_many_ranks_it_is_told_what_some_would_know(count):
    said = cuts.sentence(grid((400, 400)), {"x": 0.8, "y": 0.4}, count)
    few = min(count, 16)
    assert said.startswith(f"declare y first in state_box: {few} ranks would know about 0.4 ")
    assert cuts.sentence(grid((300, 300)), {"x": 0.8, "y": 0.4}, count) == ""
    assert cuts.sentence(grid((400, 400)), None, count) == ""


@pytest.mark.parametrize(("shape", "most", "blocks"), [
    ((5, 7), 100, (5, 7)), ((100, 100), 100, (10, 10)), ((3, 100), 30, (3, 10)),
    ((100, 3), 30, (10, 3)), ((1, 50), 8, (1, 8)), ((9, 9, 9), 1, (1, 1, 1)),
])  # fmt: skip
def test_blocks_fill_the_box(shape, most, blocks):
    found = cuts.Blocks.of(grid(shape), most)
    assert found.shape == blocks
    assert found.volume(np.arange(np.prod(blocks))).sum() == np.prod(shape)
    assert np.all(np.diff(found.middles) > 0)


def shear():
    """x+ = x + 0.6 y on 120 x 100 cells: far along x, little along y."""
    return made({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x + 0.6*y", "y": "y + 0.05*u - 0.1*x"}},
        "state_box": {"x": {"low": -1.5, "high": 1.5, "cells": 120},
                      "y": {"low": -1, "high": 1, "cells": 100}},
        "control_grid": {"u": {"values": [-1, 0, 1]}}, "stage_cost": "1",
        "attractor": {"boxes": [{"x": [-0.25, 0.25], "y": [-0.2, 0.2]}]},
        "sampling": {"kind": "grid", "per_axis": 2},
    })  # fmt: skip


def finer(name, factor):
    problem = lm.load(EXAMPLES / f"{name}.json")
    cells = {x: {**axis.model_dump(), "cells": factor * axis.cells}
             for x, axis in problem.state_box.items()}  # fmt: skip
    return problem.replaced(state_box=cells)


@pytest.mark.parametrize(("make", "least"), [
    (lambda: made(standard_map(90)), 1.3), (shear, 1.5), (lambda: finer("henon_map", 2), 1.1),
    (lambda: finer("double_integrator", 2), 2),
])  # fmt: skip
def test_few_cells_tell_what_all_count(monkeypatch, make, least):
    """One in ten; ``least`` is how many times worse the worse axis is, so that there is one."""
    monkeypatch.setattr(looking, "MOST_CELLS", 900)
    lp = local(lm.compile(make()))
    for count in (2, 4):
        found, exact = looking.estimated(lp, count), counted(lp, count)
        for axis, x in exact.items():
            assert x / 1.25 <= found[axis] <= 1.25 * x
        best, other = sorted(exact, key=exact.get)
        if count == 2:
            assert exact[other] > least * exact[best]
        assert found[best] < found[other]


@pytest.mark.parametrize("count", [2, 3])
def test_the_same_cells_are_looked_at_by_any_number_of_ranks(count):
    problem = made(standard_map(90))
    expected = looking.estimated(local(lm.compile(problem)), 5)

    def program(ranks):
        return looking.estimated(compiled(ranks, problem), 5)

    assert as_threads(count, program) == [expected] * count


def test_all_ranks_say_which_axis_to_declare_first(monkeypatch):
    monkeypatch.setattr(cuts, "LARGE", 324)
    for count in (1, 2, 3):
        every = answers(shifted(), count)
        told = (f"; declare y first in state_box: {count} ranks would know about 0 cells of others "
                f"for each own one instead of {(count - 1) / 8:.2g}")  # fmt: skip
        for each in every:
            assert each.message.endswith(told) == (count > 1)
            assert each.message.count("; declare") == (count > 1)
            known = {"x": pytest.approx((count - 1) / 8), "y": 0}
            assert each.ghosts_by_axis == (known if count > 1 else None)
    monkeypatch.setattr(cuts, "LARGE", 325)
    assert "declare" not in answers(shifted(), 2)[0].message


def recorded():
    """What the shift does, as data: their cells have no order that anybody chose."""
    x, y = (a.ravel() + 0.5 for a in np.meshgrid(np.arange(8.0), np.arange(3.0), indexing="ij"))
    box = {"x": {"low": 0, "high": 9, "cells": 9}, "y": {"low": 0, "high": 3, "cells": 3}}
    keys = {"control_grid": {}, "stage_cost": "1", "attractor": {"boxes": [{"x": [8, 9]}]}}
    return lm.from_data({"x": x, "y": y}, {}, {"x": x + 1, "y": y}, state_box=box, **keys)


def along_x(**more):
    """A shift along x alone, and axes of one cell."""
    box = shifted().state_box["x"].model_dump()
    single = {name: {"low": 0, "high": 1, "cells": 1} for name in more}
    return shifted().replaced(state_box={"x": box, **single},
                              system={"kind": "map", "next": {"x": "x + 3", **more}})  # fmt: skip


@pytest.mark.parametrize("problem", [
    along_x(), along_x(y="y"), recorded(), made(steps(attractor={"cells": [[1]]})),
])  # fmt: skip
def test_nothing_is_said_where_there_is_no_axis_to_choose(monkeypatch, problem):
    monkeypatch.setattr(cuts, "LARGE", 1)
    for each in answers(problem, 2):
        assert each.ghosts_by_axis is None
        assert "declare" not in each.message


def test_nothing_is_known_where_no_cell_can_be_stabilized():
    """All leave the box."""
    for each in answers(
        shifted().replaced(system={"kind": "map", "next": {"x": "-1", "y": "y"}}), 2
    ):
        assert (each.status, each.ghosts, each.ghosts_by_axis) == ("not_stabilizable", 0, None)


@pytest.mark.parametrize(("counted", "said"), [
    ({"x": 0.5, "y": 0.3}, ("y", 0.3, 0.5)), ({"x": 0.5, "y": 0.35}, None),
    ({"x": 0.06, "y": 0.02}, None), ({"y": 0.1}, None), ({"x": 0.1, "y": 0.5}, None),
    ({"x": 0.5, "y": 0.3, "z": 0.1}, ("z", 0.1, 0.5)),
])  # fmt: skip
def test_what_is_worth_a_word(counted, said):
    """A third fewer, and more than a cell in twenty; where the first axis was counted."""
    assert cuts.better(grid((9, 9, 9)), counted) == said
    moved = grid((1, 9, 9, 9))  # of one cell: cut along the next
    named = dict(zip("xyz", "yzv", strict=True))
    told = cuts.better(moved, {named[x]: n for x, n in counted.items()})
    assert told == (said and (named[said[0]], *said[1:]))


@pytest.mark.parametrize(("counts", "blocks", "pairs"), [
    ((10**6, 10**6, 10**7, 2 * 10**7), 4096, 64), ((10**6, 10**5, 10**6, 10**6), 40960, 64),
    ((10**6, 100, 100, 100), 65536, 64), ((10**9, 10**9, 10**12, 10**13), 256, 51),
    ((10**6, 10**6, 10**9, 10**13), 256, 4),
])  # fmt: skip
def test_few_cells_are_looked_at_whatever_the_size(counts, blocks, pairs):
    assert looking._wanted(*counts) == (blocks, pairs)

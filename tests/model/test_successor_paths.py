"""Enclosed paths: no obstacle is cut, and none is met that a step leads away from."""

import numpy as np
from test_successors import declared, line, states_of, successors

import lmdsl as lm
from lmdsl.certificate import safety
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.inclusion import Inclusion
from lmdsl.results.directory.recorded import policy_of

CORRIDOR = {
    "kind": "ode", "derivative": {"x": "cos(a)", "y": "sin(a)"}, "step": 0.5, "substeps": 1,
}  # fmt: skip
WALLS = declared(
    CORRIDOR,
    {"x": line(0, 3, 15), "y": line(0, 3, 15)},
    controls={"a": {"low": -2.4, "high": 2.4, "points": 9}},
    attractor={"boxes": [{"x": [2.4, 3], "y": [2.4, 3]}]},
    avoid={"boxes": [{"x": [1.4, 1.6], "y": [0, 2.2]}]},
)


def test_paths_do_not_cut_through_obstacles():
    rng = np.random.default_rng(0)
    partition, transitions, found, cell = successors(WALLS)
    controls = lm.compile(WALLS).controls
    late = np.linspace(0, 1, 41)[1:]
    crossings = 0
    for pair in range(transitions.rows.count):
        x = states_of(partition, cell[pair], 20, rng)
        a = controls[transitions.control[pair], 0]
        way = 0.5 * late[:, None, None] * np.array([np.cos(a), np.sin(a)])
        places = partition.locate(list(np.moveaxis(x + way, -1, 0)))
        bad = (places < 0) | transitions.sets.avoid[places]
        entered = np.cumsum(transitions.sets.attractor[places] & (places >= 0), axis=0) > 0
        lost = (bad & ~entered).any()
        crossings += lost
        assert not (lost and found.admissible[pair]), pair
    assert crossings
    result = lm.solve(WALLS)
    assert result.verified
    assert result.simulate(starts=2_000, as_compiled=True).lost == 0


def test_a_step_beside_a_wall_that_leads_away_is_kept():
    partition, transitions, found, cell = successors(WALLS)
    beside = partition.locate([np.array(1.3), np.array(0.7)]).item()
    controls = lm.compile(WALLS).controls
    kept = {
        float(controls[transitions.control[k], 0])
        for k in np.flatnonzero((cell == beside) & found.admissible)
    }
    assert kept == {a for a in controls[:, 0].tolist() if np.cos(a) < -1e-3}


def test_surely_absorbed_on_the_way_may_end_anywhere():
    """The step leads through the attractor into avoid: sampled and enclosed agree that it ends."""
    problem = declared(
        {"kind": "ode", "derivative": {"x": "1"}, "step": 1.0},
        {"x": line(0, 4, 16)}, {}, {"boxes": [{"x": [0.5, 1.25]}]},
        avoid={"boxes": [{"x": [1.25, 2]}]},
    )  # fmt: skip
    lp = lm.compile(problem)
    assert set(lp.cells.tolist()) == {0, 1}
    assert lp.sure_levels[[0, 1]].tolist() == [1, 1]


def test_a_wrong_control_is_refused():
    """Every control of every fourth cell is judged anew as compiling judged it, or found better."""
    lp = lm.compile(WALLS)
    assert safety.kept(lp, policy_of(lp, lm.solve(lp))).all()
    sets, allowed = CellSets.of(WALLS, lp.partition), np.isin(lp.cell_status, (0, 1))
    judge = Inclusion(WALLS, lp.partition, sets, allowed)
    rng, late = np.random.default_rng(2), np.linspace(0, 1, 41)[1:]
    refused = 0
    for i, cell in list(enumerate(lp.cells))[::4]:
        surviving = lp.control[lp.pair_pointer[i] : lp.pair_pointer[i + 1]]
        every = np.arange(len(lp.controls))
        for control, proved in enumerate(judge(np.full(len(every), cell), every)):
            assert proved or control not in surviving
            refused += not proved
            x = states_of(lp.partition, cell, 20, rng)
            a = lp.controls[control, 0]
            way = 0.5 * late[:, None, None] * np.array([np.cos(a), np.sin(a)])
            places = lp.partition.locate(list(np.moveaxis(x + way, -1, 0)))
            entered = np.cumsum(sets.attractor[places] & (places >= 0), axis=0) > 0
            lost = (((places < 0) | sets.avoid[places]) & ~entered).any()
            assert not (proved and lost)
    assert refused > 40


def test_only_where_it_is_judged_a_path_is_absorbed():
    """Slow cells beside fast ones: their arcs are judged at the end only, past the attractor.

    From x near 0 a step turns round a corner of the attractor: it is in there on the way, but its
    two judged places are outside. So it is not absorbed, and ends in avoid.
    """
    problem = declared(
        {"kind": "ode", "derivative": {"x": "where(x > 2, 6, 0.4)", "y": "0"}, "step": 1.0},
        {"x": line(0, 16, 160), "y": line(0, 1, 1)}, {},
        {"boxes": [{"x": [0.2, 0.3]}, {"x": [4, 16]}]},
        avoid={"boxes": [{"x": [0.4, 0.5]}]},
    )  # fmt: skip
    partition, _, found, cell = successors(problem)
    result = lm.solve(problem)
    status = result.cell_status
    rng = np.random.default_rng(0)
    for pair in np.flatnonzero(found.admissible):
        x = states_of(partition, cell[pair], 40, rng)
        h = np.where(x[:, 0] > 2, 6, 0.4)
        places = np.maximum(np.ceil(2 * h / 0.1), 1)  # equally spaced, the end among them
        for start, way, count in zip(x[:, 0], h, places, strict=True):
            at = start + way * np.arange(1, count + 1) / count
            where = partition.locate([at, np.full(len(at), 0.5)])
            events = status[np.where(where >= 0, where, 0)]
            events = np.where(where < 0, 5, events)
            decisive = events[np.isin(events, (0, 5))]
            assert not len(decisive) or decisive[0] == 0

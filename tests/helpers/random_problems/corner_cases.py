"""Hand-written problems with what lies on edges."""

from random_problems.families import Problem, axis


def _line(
    name: str, text: str, cells: int, high: int, attractor: Problem, controls: Problem, **more
) -> Problem:
    """Make a map of one state x on [0, high], unit cost, one sample in the middle of a cell."""
    problem: Problem = {
        "format": "lmdsl/1",
        "name": name,
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": axis(0, high, cells, more.pop("periodic", False))},
        "attractor": attractor,
        "control_grid": controls,
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
    }
    problem.update(more)
    return problem


FIRST: Problem = {"cells": [[0]]}
STEP: Problem = {"u": {"low": 0, "high": 1, "points": 2}}


CORNER_CASES: list[Problem] = [
    _line("shift", "x - 0.25*u", 4, 1, FIRST, STEP, gamma=1.5),
    # attractors that touch several cells
    _line("point on an edge", "x - u", 4, 4, {"points": [[1]]}, STEP),
    _line("point at high", "x + u", 4, 4, {"points": [{"x": 4}]}, STEP),
    _line("point near an edge", "x - u", 4, 4, {"points": [[1.0000000005]]}, STEP),
    _line("point not near an edge", "x - u", 4, 4, {"points": [[1.000000002]]}, STEP),
    _line("point on the seam", "x - u", 4, 4, {"points": [[4]]}, STEP, periodic=True),
    {
        **_line("point on a corner", "x - u", 4, 4, {"points": [[1, 2]]}, STEP),
        "system": {"kind": "map", "next": {"x": "x - u", "y": "y"}},
        "state_box": {"x": axis(0, 4, 4), "y": axis(0, 4, 4, True)},
    },
    _line("box that nearly holds two cells", "x - u", 4, 4, {"boxes": [{"x": [0, 1.9]}]}, STEP),
    # images on edges: sample x = i + 0.5, so that x - 0.5 is an edge
    _line("image on an edge", "x - 0.5*u", 4, 4, FIRST, STEP),
    _line("image at high", "x + 0.5*u", 4, 4, {"cells": [[3]]}, STEP),
    _line("image at low", "x - 0.5*u", 4, 4, {"cells": [[3]]}, {"u": {"values": [1]}}),
    _line(
        "images around edges",
        "where(x < 1, x, where(x < 2, 1 - u*1e-10, where(x < 3, u*1e-10, 4 + u*1e-10)))",
        4,
        4,
        FIRST,
        {"u": {"values": [5, -5, 20, -20]}},
    ),
    # one-cell axes
    {
        **_line("one-cell axis", "x - u", 4, 4, FIRST, STEP),
        "system": {"kind": "map", "next": {"one": "one + 0.25", "x": "x - u", "turn": "turn - 7"}},
        "state_box": {
            "one": axis(-1, 1, 1),
            "x": axis(0, 4, 4),
            "turn": axis(0, 1, 1, True),
        },
        "attractor": {"cells": [[0, 0, 0]]},
    },
    # causes
    _line("everything escapes", "x + 10*u", 4, 4, FIRST, {"u": {"values": [1, -1]}}),
    _line("everything trapped", "x + 0*u", 4, 4, FIRST, STEP),
    _line(  # cell 1 goes to 0 or 3, 2 to 1, 3 leaves the box, 4 stays or goes to 2
        "leads to these",
        "where(x < 2, 0.5 + 3*w, where(x < 3, 1.5, where(x < 4, -1, where(u < 1, 4.5, 2.5))))",
        5,
        5,
        FIRST,
        STEP,
        noise={"w": {"values": [0, 1], "weights": [0.5, 0.5]}},
    ),
    _line(  # cell 2 goes to 1 or, with the other control, to 0 or the trap at 3
        "the risky shortcut does not survive",
        "where(x < 2, 0.5, where(x < 3, where(u < 1, 1.5, 0.5 + 3*w), 3.5))",
        4,
        4,
        FIRST,
        STEP,
        noise={"w": {"values": [0, 1], "weights": [0.5, 0.5]}},
    ),
    _line(  # half of the mass of cell 1 falls into the trap at 3
        "half of it is trapped",
        "where(x < 2, 0.5 + 3*w, where(x < 3, 1.5, 3.5))",
        4,
        4,
        FIRST,
        {},
        noise={"w": {"values": [0, 1], "weights": [0.5, 0.5]}},
    ),
    _line("values not sorted", "x - u", 4, 4, FIRST, {"u": {"values": [2, 0, 1, -1]}}),
    # noise
    _line(
        "zero weight is dropped",
        "x - 1 + w",
        4,
        4,
        FIRST,
        {},
        noise={"w": {"values": [0, 100], "weights": [1, 0]}},
    ),
    _line(
        "small weight counts",
        "x - 1 + w",
        4,
        4,
        FIRST,
        {},
        noise={"w": {"values": [0, 100], "weights": [1 - 1e-12, 1e-12]}},
    ),
    _line(
        "weights that are not dyadic",
        "x - w",
        4,
        4,
        {"cells": [[0], [1]]},
        {},
        noise={"w": {"values": [0, 1, 2], "weights": [0.1, 0.2, 0.7]}},
    ),
    # clip
    _line("clip", "x - 10*u", 4, 4, FIRST, STEP, on_exit="clip"),
    _line(
        "clip with avoid",
        "x - 1 + 10*u",
        4,
        4,
        FIRST,
        {"u": {"values": [1, 0]}},
        on_exit="clip",
        avoid={"boxes": [{"x": [3, 4]}]},
    ),
    _line(
        "avoid touches without overlap",
        "x - u",
        4,
        4,
        FIRST,
        STEP,
        avoid={"boxes": [{"x": [2.0000000005, 2.5]}, {"x": [3.9999999995, 7]}]},
    ),
    _line(
        "clip does not save an infinite image",
        "where(u > 0, 1/(x - 1.5), x - 1)",
        4,
        4,
        FIRST,
        STEP,
        on_exit="clip",
    ),
    # periodic images many turns away, numbers exact in doubles
    _line(
        "many turns",
        "x + 4*u - 1",
        4,
        4,
        FIRST,
        {"u": {"values": [1000000, -1000000, 1099511627776]}},
        periodic=True,
    ),
    _line("NaN for some controls", "sqrt(u)*0 + x - 1", 4, 4, FIRST, {"u": {"values": [-1, 0, 1]}}),
    # the doubling map: V = 1/(1 - gamma/2)
    *(
        _line(
            f"doubling map, gamma {gamma}",
            "2*x",
            2,
            1,
            FIRST,
            {},
            periodic=True,
            gamma=gamma,
            sampling={"kind": "grid", "per_axis": 4},
        )
        for gamma in (0.5, 1, 1.5, 2, 3)
    ),
    # zeros in the cost: staying is free, going costs 1
    _line("stay for free", "x - u", 4, 4, FIRST, STEP, stage_cost="u"),
    _line("stay for free, discounted", "x - u", 4, 4, FIRST, STEP, stage_cost="u", gamma=0.9),
    _line("stay for free, growing", "x - u", 4, 4, FIRST, STEP, stage_cost="u", gamma=1.25),
    _line("all is free", "x - u", 4, 4, FIRST, STEP, stage_cost="0*u", gamma=1.25),
    # conditions, and named subexpressions
    _line("where as a box", "x - u", 6, 6, {"where": "x <= 2 and x > -1"}, STEP),
    _line(
        "where on either side of the seam",
        "x + u - 0.25",
        8,
        4,
        {"where": ["x <= 0.5", "x >= 3.5"]},
        {"u": {"values": [-0.5, 0.5]}},
        periodic=True,
        avoid={"where": "abs(x - 2) < 0.2", "boxes": [{"x": [1, 1.5]}]},
    ),
    _line(
        "where, mod and not",
        "mod(x - u, 8)",
        8,
        8,
        {"where": "not x > 1 or 3 >= x and x >= 2", "cells": [[7]]},
        STEP,
        measure={"where": ["x >= 4", "mod(x, 4) <= 1"]},
    ),
    _line(
        "admissible by state",
        "x - u",
        5,
        5,
        FIRST,
        {"u": {"values": [0, 1, 2]}},
        admissible="u <= 1 or x > 3 and far > 1",
        let={"far": "x - 1.5", "small": "u/2 + far*0"},
        stage_cost="small**2 + where(far < 1 and not u > 0, 2, 1)",
    ),
    _line(
        "let in the map and the density",
        "down + w",
        4,
        4,
        FIRST,
        {"u": {"values": [0, 1]}},
        let={"v": "2*k*u", "down": "x - v", "heavy": "x + k"},
        system={"kind": "map", "parameters": {"k": 0.5}, "next": {"x": "down + w"}},
        noise={"w": {"values": [0, -0.5], "weights": [0.5, 0.5]}},
        on_exit="clip",
    ),
    # measure
    _line(
        "measure outside C",
        "where(x < 3, x - u, x)",
        4,
        4,
        FIRST,
        STEP,
        measure={"boxes": [{"x": [3, 4]}]},
    ),
    _line(
        "measure on one cell",
        "x - u",
        4,
        4,
        FIRST,
        STEP,
        measure={"boxes": [{"x": [0, 1]}, {"x": [1.5, 3]}]},
    ),
]

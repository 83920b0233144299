"""The cells of attractor, avoid and measure."""

import itertools
from typing import Any

import numpy as np

from reference.formulas import value_of
from reference.grid import (
    EDGE,
    cells_inside,
    cells_overlapped,
    flat,
    number_of_cells,
    product_cells,
    read_axes,
    unflat,
)


def conditions_of(problem: dict[str, Any], key: str) -> list[str]:
    """The conditions under `where`, a text or a list of texts."""
    where = (problem.get(key) or {}).get("where", [])
    return [where] if isinstance(where, str) else where


def cells_where(problem: dict[str, Any], text: str, everywhere: bool) -> set[int]:
    """Cells on which a condition holds: at all of many points, the corners among them, or at one.

    A cell is judged without EDGE widths at each side. The points decide for a set that is convex
    (everywhere), and for one whose complement is convex (somewhere); for others only nearly.
    """
    axes = read_axes(problem)
    holds = value_of(problem, text)
    per_axis = 9 if len(axes) == 1 else 5
    found = set()
    for number in range(number_of_cells(axes)):
        ends = [
            (a.low + (i + EDGE) * a.width, a.low + (i + 1 - EDGE) * a.width)
            for a, i in zip(axes, unflat(axes, number), strict=True)
        ]
        points = itertools.product(*(np.linspace(*end, per_axis) for end in ends))
        names = [axis.name for axis in axes]
        held = (holds(dict(zip(names, point, strict=True))) for point in points)
        if all(held) if everywhere else any(held):
            found.add(number)
    return found


def attractor_cells(problem: dict[str, Any]) -> set[int]:
    axes = read_axes(problem)
    where = problem["attractor"]
    found: set[int] = set()
    for point in where.get("points", []):
        values = [point[a.name] for a in axes] if isinstance(point, dict) else point
        touched = [a.touched_by(v) for a, v in zip(axes, values, strict=True)]
        found |= product_cells(axes, touched)
    for box in where.get("boxes", []):
        found |= cells_inside(axes, box)
    for index in where.get("cells", []):
        found.add(flat(axes, index))
    for text in conditions_of(problem, "attractor"):
        found |= cells_where(problem, text, everywhere=True)
    return found


def avoid_cells(problem: dict[str, Any]) -> set[int]:
    axes = read_axes(problem)
    found: set[int] = set()
    for box in problem.get("avoid", {}).get("boxes", []):
        found |= cells_overlapped(axes, box)
    for text in conditions_of(problem, "avoid"):
        found |= cells_where(problem, text, everywhere=False)
    return found


def measure_cells(problem: dict[str, Any]) -> set[int] | None:
    """Cells in the sets of `measure`; None if the problem has no `measure`."""
    if problem.get("measure") is None:
        return None
    axes = read_axes(problem)
    found: set[int] = set()
    for box in problem["measure"].get("boxes", []):
        found |= cells_inside(axes, box)
    for text in conditions_of(problem, "measure"):
        found |= cells_where(problem, text, everywhere=True)
    return found

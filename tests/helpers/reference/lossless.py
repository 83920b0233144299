"""What a controller can keep that loses no run, as far as some states of every cell tell."""

import itertools
from typing import Any

from reference.grid import number_of_cells, read_axes, unflat
from reference.samples import control_vectors, noise_nodes, sample_of
from reference.steps import step_function

INSET = 2.0**-20


def lossless_cells(
    problem: dict[str, Any], per_axis: int, A: set[int], Z: set[int]
) -> tuple[set[int], set[tuple[int, int]]]:
    """The greatest set of cells that keep a control under which all states lead to it or to A,
    and the pairs that do. States: `per_axis` on each axis, from next to one face to the other."""
    axes, names = read_axes(problem), list(problem["state_box"])
    names += [*problem["control_grid"], *problem.get("noise", {})]
    step = step_function(problem, axes, A, Z)
    line = [INSET + (1 - 2 * INSET) * i / (per_axis - 1) for i in range(per_axis)]
    offsets = list(itertools.product(line, repeat=len(axes)))
    controls = list(enumerate(control_vectors(problem)))
    kept = set(range(number_of_cells(axes))) - A - Z
    ends: dict[tuple[int, int], set] = {}
    for cell, (number, u) in itertools.product(kept, controls):
        ends[cell, number] = {
            step(dict(zip(names, [*x, *u, *w], strict=True)))[0]
            for offset in offsets
            for w, _ in noise_nodes(problem)
            for x in [map(sample_of, axes, unflat(axes, cell), offset)]
        }
    while True:
        pairs = {pair for pair, end in ends.items() if end <= kept | {"absorbed"}}
        left = {cell for cell, _ in pairs if cell in kept}
        if left == kept:
            return kept, {pair for pair in pairs if pair[0] in kept}
        kept = left

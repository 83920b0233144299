"""The models, by name: declared problems, and one random model without dynamics."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import lmdsl as lm
from benchmarks import internals

GRID = {"kind": "grid", "per_axis": 4}


@dataclass(frozen=True)
class Model:
    """A model.

    Attributes
    ----------
    name
        ``family-size``.
    make
        Returns the problem, or the LP of a model that has no dynamics.
    gamma
        Its own gamma, at which the LP solvers run.
    """

    name: str
    make: Callable[[], lm.Problem | lm.StabilizationLP]
    gamma: float = 1.0

    @property
    def family(self) -> str:
        """The name without the size."""
        return self.name.rpartition("-")[0]

    def compiled(self, gamma: float | None = None) -> lm.StabilizationLP:
        """Return the LP at a gamma, by default the model's own."""
        gamma = self.gamma if gamma is None else gamma
        made = self.make()
        if isinstance(made, lm.Problem):
            return lm.compile(made.replaced(gamma=gamma))
        return replace(made, gamma=gamma)


def problem(
    kind: str, cells: dict[str, int], controls: int, sampling: dict[str, Any], **more: Any
) -> lm.Problem:
    """Return the example of a named system with another resolution."""
    data = copy.deepcopy(dict(lm.systems.NAMED[kind].problem))
    for axis, count in cells.items():
        data["state_box"][axis]["cells"] = count
    data["control_grid"]["u"]["points"] = controls
    data["system"].update(more.pop("system", {}))
    return lm.Problem.model_validate({**data, "sampling": sampling, **more})


def standard_map(cells: int) -> Model:
    """Return the paper's example: 21 controls, 10 samples a cell, gamma 1.02."""
    sampling = {"kind": "random", "points": 10, "seed": 0}
    return Model(
        f"standard-map-{cells}",
        lambda: problem("standard_map", {"x": cells, "y": cells}, 21, sampling),
        1.02,
    )


def pendulum_on_cart(cells: int) -> Model:
    """Return the pendulum on a cart: 33 controls, 16 samples a cell."""
    return Model(
        f"pendulum-on-cart-{cells}",
        lambda: problem("pendulum_on_cart", {"phi": cells, "omega": cells}, 33, GRID),
    )


def slow(cells: int) -> Model:
    """Return the inverted pendulum at a step of 0.01 s: hundreds of steps to the attractor.

    So short a step leaks through the edge of the box from everywhere; images are clipped to it.
    """
    return Model(
        f"slow-pendulum-{cells}",
        lambda: problem(
            "inverted_pendulum",
            {"theta": cells, "omega": cells},
            21,
            GRID,
            system={"step": 0.01, "substeps": 1},
            on_exit="clip",
        ),
    )


def lorenz(cells: int) -> Model:
    """Return the Lorenz system: 11 controls, 10 samples a cell."""
    sampling = {"kind": "random", "points": 10, "seed": 0}
    return Model(
        f"lorenz-{cells}",
        lambda: problem("lorenz", {"x": cells, "y": cells, "z": cells}, 11, sampling),
    )


def boost_converter(cells: int) -> Model:
    """Return safety as a problem of lmdsl: a random kill is the goal, and the only one.

    The converter of Girard, Pola and Tabuada (2010) has two modes and stays in a box as long as the
    controller wants; each step ends the run with probability 0.01.
    """
    first = "0.9917012926388760 * i + 0.1659741472224808"
    second = "0.9902950294282973 * i - 0.0328923188237173 * v + 0.1658729187526563"
    low, high = 1.14975, 1.54975
    edge = low + (high - low) / cells  # the first cells are the goal: flows must not enter
    image = f"where(mode == 1, {first}, {second})"
    return Model(
        f"boost-converter-{cells}",
        lambda: lm.Problem.model_validate({
            "format": "lmdsl/1",
            "system": {"kind": "map", "next": {
                "i": f"where(kill == 1, {low + 0.5 * (edge - low)!r},"
                     f" where({image} < {edge!r}, 99, {image}))",
                "v": "where(kill == 1, 5.65, where(mode == 1, 0.9929178767321044 * v,"
                     " 0.0352417701682685 * i + 0.9923331784696955 * v + 0.0029450833173848))",
            }},
            "state_box": {"i": {"low": low, "high": high, "cells": cells},
                          "v": {"low": 5.45025, "high": 5.84975, "cells": max(cells - 1, 1)}},
            "attractor": {"boxes": [{"i": [low, edge]}]},
            "control_grid": {"mode": {"values": [1, 2]}},
            "noise": {"kill": {"values": [0, 1], "weights": [0.99, 0.01]}},
            "stage_cost": "1",
            "sampling": {"kind": "grid", "per_axis": 2},
        }),
    )  # fmt: skip


def random_model(cells: int) -> Model:
    """Return a random sparse model: 10 controls, about 4 successors anywhere, no locality."""
    return Model(f"random-{cells}", lambda: internals.random_lp(cells, 10, 4, 10))


MODELS = {
    model.name: model
    for model in (
        *(standard_map(cells) for cells in (50, 100, 200, 500, 1000)),
        *(pendulum_on_cart(cells) for cells in (64, 128, 256)),
        slow(200),
        lorenz(40),
        random_model(20_000),
    )
}
"""The models of a full run."""

MAKERS: dict[str, Callable[[int], Model]] = {
    "standard-map": standard_map,
    "pendulum-on-cart": pendulum_on_cart,
    "slow-pendulum": slow,
    "lorenz": lorenz,
    "boost-converter": boost_converter,
    "random": random_model,
}

SMOKE = ("standard-map-8",)
"""The models of a smoke run."""

WARM = "standard-map-8"
"""Solved once by every contestant before anything else, so that kernels are compiled."""


def get(name: str) -> Model:
    """Return a model by name; any size of a known family will do.

    Raises
    ------
    ValueError
        There is no such family.
    """
    family, _, size = name.rpartition("-")
    if family not in MAKERS or not size.isdigit():
        raise ValueError(f"{name!r} is no model; write FAMILY-SIZE with {', '.join(MAKERS)}")
    return MAKERS[family](int(size))

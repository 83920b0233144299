"""Problems that take for ever."""

from __future__ import annotations

import itertools

import numpy as np
from problems import made, steps

from lmdsl.machine.deadline import Deadline


class Asked(Deadline):
    """A deadline that passes when it is asked for the n-th time."""

    def __init__(self, n=np.inf):
        super().__init__()
        self.counter, self.n, self.count = itertools.count(1), n, 0

    def __call__(self):
        self.count = next(self.counter)
        return self.count >= self.n or super().__call__()


def sines(points=4, substeps=1000, cells=4):
    """A file of a few lines with as many sines as one likes in every block."""
    text = "+".join(f"0*sin({k}*x)" for k in range(1, 50))
    return steps(
        system={"kind": "ode", "derivative": {"x": f"-u+{text}"}, "step": 0.25,
                "substeps": substeps},
        sampling={"kind": "random", "points": points},
        state_box={"x": {"low": 0, "high": 1, "cells": cells}},
    )  # fmt: skip


def local(nodes=5, substeps=2, cells=400):
    data = sines(substeps=substeps, cells=cells)
    data["system"]["derivative"]["x"] += "+0*w-10*x"
    data["state_box"]["x"]["low"] = -1
    data["attractor"] = {"boxes": [{"x": [-0.5, 0.5]}]}
    data["noise"] = {"w": {"normal": {"std": 0.01, "points": nodes}}}
    data["control_grid"] = {"u": {"values": [0]}}
    data["local_controller"] = {"kind": "constant"}
    return made(data)


def checked(problem, *arguments, **more):
    from lmdsl.control.invariance import examine
    from lmdsl.model.grid.partition import Partition
    from lmdsl.model.local.controller import LocalController
    from lmdsl.model.sets import CellSets

    partition = Partition.of(problem)
    attractor = CellSets.of(problem, partition).attractor
    return examine(problem, LocalController.of(problem, partition, attractor), *arguments, **more)

"""The controller as an ONNX graph: the table of cells, and the arithmetic that finds a cell.

Input ``x`` (r, d) and output ``u`` (r, p) are doubles, output ``index`` (r,) int64: that of the
control, M where the local feedback acts, -1, with u NaN, where there is no control. The operations
are those of grid/axis.py, one by one on doubles, so that a runtime that rounds each gives the same
bits as Python.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.common.optional import needed
from lmdsl.control.controller import Controller
from lmdsl.errors import BadInput, printable
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.axis import EDGE, MOST_TURNS, AxisCells
from lmdsl.model.local.controller import LocalController
from lmdsl.model.lp import StabilizationLP
from lmdsl.results.directory.writing import refuse_own_file
from lmdsl.results.exports.c import codes, digest
from lmdsl.results.result import Result

OPSET, IR = 17, 8  # of ONNX 1.12, so that older runtimes read it
MOST_BYTES = 2**31 - 2**20  # of a file of ONNX


@own_arithmetic
def export_onnx(result: Result, path: str | os.PathLike[str]) -> None:
    """Write the feedback controller as an ONNX graph; needs the package onnx.

    Parameters
    ----------
    result
        An answer with a controller.
    path
        The file to write; it appears whole or not at all.

    Raises
    ------
    BadInput
        The result has no controller, there are no controls to choose, the table is too large for
        the format, onnx is not installed, or the file cannot be written.
    """
    inputs.kind(result, Result, "result", "a Result")
    if not (result.control_index >= 0).any():
        raise BadInput("there is no controller to export: " + result.message)
    if not result.problem.controls:
        raise BadInput("the system has no controls, so that there is nothing to compute")
    onnx = needed("onnx", "export_onnx", "onnx")
    refuse_own_file(inputs.path(path))
    table = codes(result.controller)
    table = table.astype(next(t for t in (np.uint8, np.uint16, np.int32)
                              if table.max() <= np.iinfo(t).max))  # fmt: skip
    if table.nbytes > MOST_BYTES:
        raise BadInput(f"{len(table):,} cells are too many for a file of ONNX; use fewer")
    graph = _Graph(onnx)
    _controller(graph, result.controller, table)
    write_whole(inputs.path(path), graph.model(result).SerializeToString())


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write the controller of a result for ``lmdsl export``."""
    export_onnx(result, path)


class _Graph:
    """Nodes and constants as they are added; a value is the name of what computes it."""

    def __init__(self, onnx: Any) -> None:
        self.onnx, self.nodes, self.constants = onnx, list[Any](), list[Any]()

    def constant(self, array: Any, kind: Any = np.float64) -> str:
        """Add a constant."""
        name = f"c{len(self.constants)}"
        held = np.array(array, dtype=kind, order="C")
        self.constants.append(self.onnx.numpy_helper.from_array(held, name))
        return name

    def __call__(self, operation: str, *operands: Any, name: str = "", **settings: Any) -> str:
        """Add a node; numbers among the operands are constants."""
        named = [x if isinstance(x, str) else self.constant(x) for x in operands]
        name = name or f"n{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operation, named, [name], **settings))
        return name

    def model(self, result: Result) -> Any:
        """Return the graph with its inputs and outputs."""
        from lmdsl import __version__

        onnx, helper = self.onnx, self.onnx.helper
        double, whole = onnx.TensorProto.DOUBLE, onnx.TensorProto.INT64
        states, controls = result.problem.states, result.problem.controls
        graph = helper.make_graph(
            self.nodes,
            "controller",
            [helper.make_tensor_value_info("x", double, ["r", len(states)])],
            [
                helper.make_tensor_value_info("u", double, ["r", len(controls)]),
                helper.make_tensor_value_info("index", whole, ["r"]),
            ],
            self.constants,
        )
        model = helper.make_model(
            graph, producer_name="lmdsl", producer_version=__version__, ir_version=IR,
            opset_imports=[helper.make_opsetid("", OPSET)],
        )  # fmt: skip
        helper.set_model_props(model, {
            "problem": printable(result.problem.name or "unnamed"),
            "model": digest(result),
            "status": str(result.status),
            "states": ",".join(states),
            "controls": ",".join(controls),
        })  # fmt: skip
        return model


def _controller(graph: _Graph, controller: Controller, table: NDArray[Any]) -> None:
    """Add what leads from ``x`` to ``u`` and ``index``."""
    places, states, inside, cell = [], [], "", ""
    clip = controller.partition.clip
    for j, axis in enumerate(controller.partition.axes):
        at = graph("Gather", "x", graph.constant(j, np.int64), axis=1)
        state, k, fits = (_circle if axis.periodic else _interval)(graph, axis, at, clip)
        fits = graph("And", fits, graph("Less", graph("Abs", at), np.inf))
        part = graph("Mul", k, axis.stride)
        inside = graph("And", inside, fits) if inside else fits
        cell = graph("Add", cell, part) if cell else part
        places.append(k)
        states.append(state)
    at = graph("Cast", graph("Where", inside, cell, 0.0), to=graph.onnx.TensorProto.INT64)
    code = graph("Gather", graph.constant(table, table.dtype), at)
    code = graph("Cast", code, to=graph.onnx.TensorProto.INT64)
    code = graph("Where", inside, code, graph.constant(0, np.int64))
    vectors, local = controller.vectors, controller.local
    rows = np.concatenate([np.full((1, vectors.shape[1]), np.nan), vectors])
    most = graph.constant(len(vectors), np.int64)
    found = graph("Gather", graph.constant(rows), graph("Min", code, most), axis=0,
                  name="" if local else "u")  # fmt: skip
    index = graph("Sub", code, graph.constant(1, np.int64), name="" if local else "index")
    if local is None:
        return
    first = graph.constant(len(vectors) + 1, np.int64)
    k = graph("Max", graph("Sub", code, first), graph.constant(0, np.int64))
    fed = _feedback(graph, controller, local, k, list(zip(places, states, strict=True)))
    acts = graph("Greater", code, most)
    graph("Where", graph("Unsqueeze", acts, graph.constant([1], np.int64)), fed, found, name="u")
    graph("Min", index, most, name="index")


def _circle(graph: _Graph, axis: AxisCells, at: str, clip: bool) -> tuple[str, str, str]:
    """Return the state on a circle, its index, and whether it is near enough; as on_circle does."""
    span = axis.high - axis.low
    away = graph("Sub", at, axis.low)
    turns = graph("Floor", graph("Div", away, span))
    rest = graph("Sub", away, graph("Mul", turns, span))
    rest = graph("Min", graph("Max", rest, 0.0), span)
    wrapped = graph("Min", graph("Add", rest, axis.low), axis.high)
    above = graph("GreaterOrEqual", at, axis.low)
    home = graph("And", above, graph("LessOrEqual", at, axis.high))
    state = graph("Where", home, at, wrapped)
    k = _floor(graph, graph("Div", graph("Sub", state, axis.low), axis.width))
    k = graph("Where", graph("Less", k, axis.cells), k, 0.0)
    return state, k, graph("LessOrEqual", graph("Abs", turns), MOST_TURNS)


def _interval(graph: _Graph, axis: AxisCells, at: str, clip: bool) -> tuple[str, str, str]:
    """Return the state on an interval, its index, and whether it lies in the box."""
    if clip:
        at = graph("Min", graph("Max", at, axis.low), axis.high)
    t = graph("Div", graph("Sub", at, axis.low), axis.width)
    k = _floor(graph, t)
    edge = graph("LessOrEqual", graph("Sub", t, axis.cells), EDGE)
    edge = graph("Or", edge, graph("LessOrEqual", at, axis.high))
    last = graph("And", graph("GreaterOrEqual", k, axis.cells), edge)
    k = graph("Where", last, axis.cells - 1, k)
    return at, k, graph("And", graph("GreaterOrEqual", k, 0.0), graph("Less", k, axis.cells))


def _floor(graph: _Graph, t: str) -> str:
    return graph("Floor", graph("Add", t, EDGE))


def _feedback(
    graph: _Graph,
    controller: Controller,
    local: LocalController,
    k: str,
    placed: list[tuple[str, str]],
) -> str:
    """Return clip(u_k - K_k (x - x_k)), by way of the middle of the cell, shape (r, p)."""
    away = []
    for i, ((place, state), axis) in enumerate(zip(placed, controller.partition.axes, strict=True)):
        middle = graph("Mul", graph("Add", place, 0.5), axis.width)
        centre = graph("Add", middle, axis.low)
        point = graph("Gather", graph.constant(local.orbit[:, i]), k)
        origin, by = graph("Sub", centre, point), graph("Sub", state, centre)
        if axis.periodic:
            span = axis.high - axis.low
            origin, by = (_shortest(graph, each, span) for each in (origin, by))
        away.append(graph("Add", by, origin))
    controls = []
    for j in range(local.gain.shape[1]):
        u = graph("Gather", graph.constant(local.control[:, j]), k)
        for i, by in enumerate(away):
            if local.gain[:, j, i].any():
                gain = graph("Gather", graph.constant(local.gain[:, j, i]), k)
                u = graph("Sub", u, graph("Mul", gain, by))
        u = graph("Min", graph("Max", u, float(local.low[j])), float(local.high[j]))
        controls.append(graph("Unsqueeze", u, graph.constant([1], np.int64)))
    return graph("Concat", *controls, axis=1)


def _shortest(graph: _Graph, away: str, span: float) -> str:
    turns = graph("Round", graph("Div", away, span))
    return graph("Sub", away, graph("Mul", turns, span))

"""A result as labelled arrays: xarray's Dataset, a table of pandas."""

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.optional import needed
from lmdsl.errors import BadInput, shown
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.results.exports.c import digest
from lmdsl.results.exports.csv import columns, controls_at_centres, own_names
from lmdsl.results.result import Result

DESCRIBED = {
    "value": "upper bound of what the controller costs from here; 0 on the attractor",
    "lower": "lower bound of what any policy of the finite model costs from here",
    "measure": "Lyapunov measure: expected weighted number of visits, from starts drawn by m",
    "weight": "share of the starts, m",
    "control_index": "index of the control vector; -1 where there is none",
    "cell_status": "what became of the cell",
}
NUMBERS = (
    "gamma", "cost", "lower_bound", "gap", "tolerance", "contraction", "cells", "controls",
    "pairs", "attractor_cells", "stabilizable_cells",
)  # fmt: skip


def to_xarray(result: Any, units: Mapping[str, str] | None = None) -> Any:
    """See :meth:`Result.to_xarray`."""
    xarray = needed("xarray", "to_xarray", "xarray")
    problem, partition = result.problem, result.partition
    given = _units(units, (*problem.states, *problem.controls))
    coordinates = {}
    for k, (name, axis) in enumerate(problem.state_box.items()):
        centres = partition.low[k] + (np.arange(axis.cells) + 0.5) * partition.width[k]
        place = {
            "long_name": f"{name}, centre of the cell",
            "low": axis.low,
            "high": axis.high,
            "cell_width": float(partition.width[k]),
            "periodic": int(axis.periodic),
        }
        coordinates[name] = (name, centres, place | _unit(given, name))
    own = own_names(DESCRIBED, (*problem.states, *problem.controls))
    variables: dict[str, Any] = {}
    for name, u in zip(problem.controls, controls_at_centres(result).T, strict=True):
        said = {"long_name": f"{name}, control at the centre of the cell"} | _unit(given, name)
        variables[name] = (problem.states, u.reshape(partition.shape), said)
    for name, text in DESCRIBED.items():
        array = getattr(result, name).reshape(partition.shape)
        about: dict[str, Any] = {"long_name": text}
        if name == "cell_status":
            about |= {
                "flag_values": np.array([*CellStatus], dtype=np.uint8),
                "flag_meanings": " ".join(status.name.lower() for status in CellStatus),
            }
        variables[own[name]] = (problem.states, array.copy(), about)
    return xarray.Dataset(variables, coordinates, _attributes(result))


def to_dataframe(result: Any) -> Any:
    """See :meth:`Result.to_dataframe`."""
    return needed("pandas", "to_dataframe", "pandas").DataFrame(columns(result))


def _attributes(result: Result) -> dict[str, Any]:
    """Return what is said of the whole, as numbers and texts that every format can hold."""
    from lmdsl import __version__

    numbers = {name: getattr(result, name) for name in NUMBERS}
    about = {
        "title": result.problem.name or "unnamed",
        "source": f"lmdsl {__version__}",
        "Conventions": "CF-1.11",
        "status": str(result.status),
        "message": result.message,
        "model_sha256": digest(result),
        **{name: value for name, value in numbers.items() if value is not None},
    }
    if not result.problem.functions:
        with contextlib.suppress(BadInput):  # given matrices, say
            about["problem"] = result.problem.to_json()
    return about


def _units(units: Mapping[str, str] | None, names: tuple[str, ...]) -> dict[str, str]:
    if units is None:
        return {}
    inputs.kind(units, Mapping, "units", "a mapping from names to units")
    for name, unit in units.items():
        if name not in names:
            known = ", ".join(names)
            raise BadInput(f"{shown(name)} is neither axis nor control; these are {known}", "units")
        if not isinstance(unit, str):
            raise BadInput(f'{shown(unit)} is no unit; write a text, such as "m"', f"units.{name}")
    return dict(units)


def _unit(units: dict[str, str], name: str) -> dict[str, str]:
    return {"units": units[name]} if name in units else {}

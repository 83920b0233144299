"""Results as tables and labelled arrays, read back by the packages that they are for."""

import csv
import json
import sys

import numpy as np
import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm

NAMED_SO = standard_map(6, 1.0, state_box={
    "value": {"low": 0, "high": 1, "cells": 6, "periodic": True},
    "y": {"low": 0, "high": 1, "cells": 5, "periodic": True},
}, system={"kind": "map", "next": {"value": "value + y + u", "y": "y + 0.2*measure"}},
    control_grid={"u": {"values": [-0.2, 0, 0.2]}, "measure": {"values": [-1, 0, 1]}},
    attractor={"points": [{"value": 0.25, "y": 0.5}]}, stage_cost="1")  # fmt: skip
PROBLEMS = {
    "standard map": standard_map(12, name="A standard map"),
    "autonomous": doubling(),
    "names of ours": NAMED_SO,
    "local": steps(local_controller={"kind": "constant", "control": {"u": 1}}),
}


@pytest.fixture(scope="module", params=PROBLEMS)
def result(request) -> lm.Result:
    return lm.solve(made(PROBLEMS[request.param]))


def test_the_table_has_what_the_result_has(result, tmp_path):
    lm.exports.export_csv(result, tmp_path / "cells.csv")
    with open(tmp_path / "cells.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == result.cells
    own = {"value": "value_", "measure": "measure_"} if "measure" in result.problem.controls else {}
    for name in ("value", "lower", "measure", "control_index"):
        column = own.get(name, name)
        np.testing.assert_array_equal([float(row[column]) for row in rows], getattr(result, name))
    centres = result.partition.centres(np.arange(result.cells))
    u = result.controller(centres)
    for names, array in ((result.problem.states, centres), (result.problem.controls, u)):
        for k, name in enumerate(names):
            found = [float(row[name] or "nan") for row in rows]
            np.testing.assert_array_equal(found, array[:, k])
    words = [lm.CellStatus[row["status"].upper()] for row in rows]
    np.testing.assert_array_equal(words, result.cell_status)
    assert [int(row["cell"]) for row in rows] == list(range(result.cells))


def test_pandas_has_the_table(result, tmp_path):
    pandas = pytest.importorskip("pandas")
    table = result.to_dataframe()
    lm.exports.export_csv(result, tmp_path / "cells.csv")
    old = int(pandas.__version__.split(".")[0]) < 3  # then the last digit is not asked for
    exact = {"float_precision": "round_trip"} if old else {}
    read = pandas.read_csv(tmp_path / "cells.csv", **exact)
    pandas.testing.assert_frame_equal(
        read, table, check_dtype=False, check_exact=True, check_column_type=False
    )
    on = table[table["status"] == "stabilized"]
    assert len(on) == result.stabilizable_cells


def test_xarray_has_axes_as_coordinates(result):
    pytest.importorskip("xarray")
    data = result.to_xarray({result.problem.states[0]: "m"})
    states = result.problem.states
    assert dict(data.sizes) == dict(zip(states, result.partition.shape, strict=True))
    assert data[states[0]].attrs["units"] == "m"
    value = data["value_" if "value" in states else "value"]
    np.testing.assert_array_equal(value.values.ravel(), result.value)
    cell = result.cells // 2
    at = dict(zip(states, result.partition.centres(np.array([cell]))[0], strict=True))
    assert float(value.sel(at, method="nearest")) == result.value[cell]
    for name, u in zip(result.problem.controls, result.controller([list(at.values())])[0],
                       strict=True):  # fmt: skip
        np.testing.assert_array_equal(data[name].sel(at, method="nearest"), u)
    meanings = data["cell_status"].attrs["flag_meanings"].split()
    assert (
        meanings[result.cell_status[cell]] == lm.CellStatus(result.cell_status[cell]).name.lower()
    )
    assert data.attrs["cost"] == result.cost
    assert lm.Problem.model_validate(json.loads(data.attrs["problem"])) == result.problem


@pytest.mark.parametrize("kind", ["netcdf", "netcdf3", "zarr"])
def test_files_keep_all_of_it(result, kind, tmp_path):
    xarray = pytest.importorskip("xarray")
    engine = {"netcdf": "h5netcdf", "netcdf3": "scipy", "zarr": "zarr"}[kind]
    pytest.importorskip(engine)
    data = result.to_xarray()
    if kind == "zarr":
        data.to_zarr(tmp_path / "data.zarr")
        read = xarray.open_zarr(tmp_path / "data.zarr")
    else:
        data.to_netcdf(tmp_path / "data.nc", engine=engine)
        read = xarray.open_dataset(tmp_path / "data.nc", engine=engine)
    with read:
        xarray.testing.assert_equal(read.load(), data)
        for name in data.variables:
            assert set(read[name].attrs) == set(data[name].attrs)
            for key, value in data[name].attrs.items():
                np.testing.assert_array_equal(read[name].attrs[key], value)
        assert read.attrs.keys() == data.attrs.keys()
        for key, value in data.attrs.items():
            assert read.attrs[key] == value, key


def test_units_of_nothing_are_refused(result):
    pytest.importorskip("xarray")
    with pytest.raises(lm.BadInput, match="units: 'z' is neither axis nor control"):
        result.to_xarray({"z": "m"})
    with pytest.raises(lm.BadInput, match="unit"):
        result.to_xarray({result.problem.states[0]: 3})


def test_a_package_that_is_not_there_is_named(result, monkeypatch):
    for name in ("xarray", "pandas", "gymnasium", "control", "onnx"):
        monkeypatch.setitem(sys.modules, name, None)
    for call, extra in (
        (result.to_xarray, "xarray"),
        (result.to_dataframe, "pandas"),
        (lambda: lm.interop.gym_env(result), "gymnasium"),
        (lambda: lm.interop.from_gym(None, "x"), "gymnasium"),
        (lambda: lm.interop.control_system(result.problem), "control"),
        (lambda: lm.interop.state_space(result.problem, [0.0]), "control"),
    ):
        with pytest.raises(lm.BadInput, match=rf'pip install "lmdsl\[{extra}\]"'):
            call()
    if result.problem.controls:
        with pytest.raises(lm.BadInput, match=r'pip install "lmdsl\[onnx\]"'):
            lm.exports.export_onnx(result, "nowhere.onnx")

"""The systems of the zoo on a few cells, against the independent implementation of the format.

Formulas, definitions, conditions, paths and cost rates are those of the files; grids, samples and
controls are few, and the attractor is the cells around the middle of the declared one.
"""

import json

import pytest
from agreement import compare

from benchmarks import zoo

pytestmark = pytest.mark.long  # in other versions it would find nothing else

FEW = {
    "tent_map": [15],
    "circle_map": [20],
    "ikeda_map": [9, 9],
    "coupled_standard_maps": [3, 3, 3, 3],
    "duffing": [9, 8],
    "pendulum_held": [8, 8],
    "cart_pole": [3, 3, 3, 3],
    "reaction_wheel": [3, 4, 2],
    "boost_converter": [7, 7],
    "unicycle": [4, 3, 3],
    "compressor": [4, 3, 2],
    "double_gyre": [4, 3, 2],
    "rantzer": [12, 8],
    "robot": [5, 5],
    "inventory": [61],
    "epidemic": [9, 8],
    "predator_prey": [9, 9],
}


def reduced(name):
    """The data of a problem file with few of everything."""
    data = json.loads((zoo.ROOT / zoo.entries()[name]["file"]).read_text())
    for axis, cells in zip(data["state_box"].values(), FEW[name], strict=True):
        axis["cells"] = cells
    if data["attractor"]:
        boxes = data["attractor"].get("boxes", [{}])
        point = {x: sum(boxes[0].get(x, [a["low"], a["high"]])) / 2
                 for x, a in data["state_box"].items()}  # fmt: skip
        data["attractor"] = {"points": [point]}
    for grid in data["control_grid"].values():
        grid.update({"points": min(grid["points"], 3)} if "points" in grid else {})
    data["sampling"] = {"kind": "random", "points": 3}
    if "substeps" in data["system"]:
        data["system"]["substeps"] = 1
    for key in ("successors", "local_controller"):  # which are about whole cells
        data.pop(key, None)
    return {**data, "on_exit": "clip"}


@pytest.mark.parametrize("name", FEW)
def test_few_cells_are_as_the_reference_has_them(name):
    compare(reduced(name))


def test_every_file_is_compared():
    ours = {name for name, entry in zoo.entries().items() if "/zoo/" in entry["file"]}
    assert ours == FEW.keys()

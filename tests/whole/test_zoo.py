"""The zoo: every system solved anew gives its golden values, and the page shows them.

The coarsest grid of each is solved in every run of the tests; the others on request.
"""

import functools
import re

import numpy as np
import pytest

import lmdsl as lm
from benchmarks import zoo
from benchmarks.zoo import page, pictures

ZOO = zoo.entries()
WELL_BELOW = 60_000  # bytes of a picture
SLOW = {
    "cart_pole",
    "cart_pole_swing_up",
    "compressor",
    "lorenz",
    "reaction_wheel",
    "unicycle",
}  # about two seconds


@functools.cache
def compiled(name, grid=0):
    return lm.compile(zoo.problem(ZOO[name], ZOO[name]["grids"][grid]["cells"]))


def assert_as_kept(kept, found):
    """Counts agree, costs to the gap of the certificate, and runs but for single ones.

    The libraries of other machines round sines otherwise: a chaotic run may then end elsewhere.
    """
    assert found.keys() | {"cells"} == kept.keys()
    for name in ("status", "attractor_cells", "stabilizable_cells", "coverage", "pairs"):
        assert found[name] == kept[name], name
    assert found["cost"] == pytest.approx(kept["cost"], rel=1e-6)
    assert (found["gamma_bar"] is None) == (kept["gamma_bar"] is None)
    if kept["gamma_bar"]:
        assert found["gamma_bar"] == pytest.approx(kept["gamma_bar"], rel=1e-6)
    assert (found["runs"] or {}).keys() == (kept["runs"] or {}).keys()
    for outcome, count in (kept["runs"] or {}).items():
        assert found["runs"][outcome] == pytest.approx(count, abs=5), outcome


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * (n in SLOW)) for n in ZOO]
)
def test_coarsest_grid_is_as_kept(name):
    kept = ZOO[name]["grids"][0]
    assert kept["status"] == "verified"
    assert_as_kept(kept, zoo.measured(compiled(name)))


@pytest.mark.long
@pytest.mark.full
@pytest.mark.parametrize("grid", [1, 2])
@pytest.mark.parametrize("name", ZOO)
def test_finer_grids_are_as_kept(name, grid):
    kept = ZOO[name]["grids"][grid]
    assert kept["status"] == "verified"
    assert_as_kept(kept, zoo.measured(lm.compile(zoo.problem(ZOO[name], kept["cells"]))))


def test_a_value_that_moved_is_noticed():
    kept = ZOO["tent_map"]["grids"][0]
    found = {key: value for key, value in kept.items() if key != "cells"}
    assert_as_kept(kept, found)
    runs = {**kept["runs"], "reached": kept["runs"]["reached"] - 6}
    for key, value in (("cost", 1.001 * kept["cost"]), ("pairs", 1), ("gamma_bar", None),
                       ("runs", runs)):  # fmt: skip
        with pytest.raises(AssertionError):
            assert_as_kept(kept, {**found, key: value})


# What is complete -----------------------------------------------------------------------------


def test_every_file_is_in_the_zoo_and_named_systems_are():
    files = {entry["file"] for entry in ZOO.values()}
    assert {f"examples/zoo/{path.name}" for path in (zoo.ROOT / "examples/zoo").iterdir()} < files
    assert {f"examples/{kind}.json" for kind in lm.systems.NAMED} < files
    assert len(ZOO) == len(files) >= 20


@pytest.mark.parametrize("name", ZOO)
def test_grids_are_of_the_file_and_grow(name):
    entry = ZOO[name]
    sizes = [np.prod(grid["cells"]) for grid in entry["grids"]]
    assert len(sizes) == 3
    assert sizes == sorted(sizes)
    own = [axis.cells for axis in zoo.problem(entry).state_box.values()]
    assert own in [grid["cells"] for grid in entry["grids"]]


def test_the_page_shows_the_golden_values():
    text = page.PAGE.read_text()
    assert page.filled(text, ZOO) == text, "run python -m benchmarks.zoo"
    assert re.findall(r"<!-- zoo: (\w+) -->", text) == ["all", *ZOO]
    assert re.findall(r"^## (\w+)$", text, re.MULTILINE) == list(ZOO)


@pytest.mark.parametrize("name", ZOO)
def test_picture_is_small_and_shown(name):
    picture = pictures.FOLDER / f"{name}.png"
    assert 0 < picture.stat().st_size < WELL_BELOW
    assert f"(images/zoo/{name}.png)" in page.PAGE.read_text()


# What theory says -----------------------------------------------------------------------------


def test_rantzer_decays_on_cells_as_its_saddle_lets_it():
    """A cell at (2, 0) is left at the rate 2/sqrt(5), by step 1/4."""
    limit = np.exp(0.25 * 2 / np.sqrt(5))
    for grid, near in zip(ZOO["rantzer"]["grids"], (0.02, 0.002, 0.002), strict=True):
        assert np.mean(grid["gamma_bar"]) == pytest.approx(limit, rel=near)


def plain_inventory():
    """Value iteration on whole stocks, by hand."""
    stock, orders = np.arange(-20, 41), np.arange(31)
    chance = [0.05, 0.15, 0.2, 0.25, 0.2, 0.1, 0.05]
    after = stock[:, None] + orders
    cost = np.maximum(stock, 0) + 5 * np.maximum(-stock, 0)
    cost = cost[:, None] + np.where(orders > 0, 24, 0) + 2 * orders
    cost = np.where((after - 6 >= -20) & (after <= 40), cost, np.inf)
    value = np.zeros(len(stock))
    for _ in range(1000):
        mean = sum(p * value[np.clip(after - d + 20, 0, 60)] for d, p in enumerate(chance))
        value = (cost + 0.95 * mean).min(axis=1)
    return stock, value, orders[(cost + 0.95 * mean).argmin(axis=1)]


def test_inventory_is_ordered_up_to_a_level():
    """Scarf: below s order up to S, else nothing. The costs are those of plain value iteration."""
    result = lm.solve(compiled("inventory"))
    stock, value, order = plain_inventory()
    np.testing.assert_allclose(result.value, value, rtol=1e-9)
    chosen = result.control_vectors[result.control_index][:, 0]
    np.testing.assert_array_equal(chosen, order)
    ordered = (chosen > 0) & (chosen < 30)
    assert len(set((stock + chosen)[ordered])) == 1
    assert stock[chosen > 0].max() < stock[chosen == 0].min()


@pytest.mark.parametrize("name", ["circle_map", "pendulum_held", "boost_converter", "robot"])
def test_nothing_is_lost_where_successors_are_enclosed(name):
    result = lm.solve(compiled(name))
    assert result.certificate.safe is True
    kept = ZOO[name]["grids"][0]["runs"]
    assert kept["lost"] == 0
    assert kept.get("stayed", 1000) == 1000

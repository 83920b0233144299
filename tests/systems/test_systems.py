"""The systems known by name: each default problem does what a specialist expects of it."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from named_systems import NAMED, draw, images, solved, variant

import lmdsl as lm

EXAMPLES = Path(__file__).parents[2] / "examples"
# Attractor cells, stabilizable cells, and the least share of the other cells that is stabilizable.
EXPECTED = {
    "standard_map": (4, 2496, 1.0),
    "logistic_map": (2, 198, 1.0),
    "henon_map": (4, 3062, 0.9),
    "double_integrator": (4, 4216, 0.85),
    "inverted_pendulum": (4, 3840, 0.9),
    "pendulum_on_cart": (4, 3248, 0.75),
    "van_der_pol": (4, 3196, 0.85),
    "lorenz": (8, 10188, 0.86),
    "cart_pole": (32, 54914, 0.83),
}


# every system, one by one ---------------------------------------------------------------------


# The one of four dimensions takes longest: one process solves it, once.
SOLVED = [name for name in NAMED if name != "cart_pole"]
SOLVED += [
    pytest.param("cart_pole", marks=[pytest.mark.long, pytest.mark.xdist_group("cart_pole")])
]


@pytest.mark.parametrize("name", NAMED)
def test_is_documented(name):
    system = NAMED[name]
    assert system.summary
    assert system.source
    assert system.__doc__
    assert system.problem["system"]["kind"] == name
    assert system.problem["name"]
    # The file shows every parameter, so that a user sees what can be changed.
    assert system.problem["system"]["parameters"] == system.defaults
    problem = lm.Problem.model_validate(system.problem)
    assert lm.Problem.model_validate(problem.to_dict()) == problem


@pytest.mark.parametrize("name", SOLVED)
def test_is_solved_and_verified(name):
    result = solved(name)
    attractor, stabilizable, share = EXPECTED[name]
    assert result.status == "verified", result.message
    assert result.certificate.verified
    assert result.gap <= 1e-9
    assert result.attractor_cells == attractor
    # A few samples lie within rounding of an edge, so counts may differ between platforms.
    assert abs(result.stabilizable_cells - stabilizable) <= 0.005 * result.cells
    assert result.stabilizable_cells >= share * (result.cells - attractor)


@pytest.mark.parametrize("name", SOLVED)
def test_true_map_is_brought_to_the_attractor(name):
    run = solved(name).simulate(starts=2000, steps=5000, seed=1)
    assert run.reached > 0.99 * run.starts, run


@pytest.mark.parametrize("name", NAMED)
def test_unknown_parameter_is_refused(name):
    system = {**NAMED[name].problem["system"], "parameters": {"nonsense": 1.0}}
    with pytest.raises(lm.BadInput, match="is not a parameter of"):
        variant(name, system=system)


@pytest.mark.parametrize("name", NAMED)
def test_parameters_reach_the_formulas(name):
    """Changing any one parameter changes some image."""
    base = NAMED[name].problem["system"]
    rng = np.random.default_rng(0)
    before = images(variant(name), *draw(name, 20, rng))
    for key, value in NAMED[name].defaults.items():
        rng = np.random.default_rng(0)
        parameters = {**base["parameters"], key: 1.1 * value}
        after = images(
            variant(name, system={**base, "parameters": parameters}), *draw(name, 20, rng)
        )
        assert np.abs(after - before).max() > 1e-6, key


# examples -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in NAMED if name != "standard_map"])
def test_example_file_is_the_default_problem(name):
    path = EXAMPLES / f"{name}.json"
    assert json.loads(path.read_text()) == NAMED[name].problem
    assert lm.load(path) == lm.Problem.model_validate(NAMED[name].problem)


def test_standard_map_file_spells_the_named_system_out():
    """The file writes the formulas down, the system of that name knows them: one model."""
    path = EXAMPLES / "standard_map.json"
    written, known = json.loads(path.read_text()), NAMED["standard_map"].problem
    assert written["system"]["next"] == NAMED["standard_map"].formulas
    assert {**written, "system": 0} == {**known, "system": 0}
    assert lm.compile(lm.load(path)).digest == lm.compile(variant("standard_map")).digest


def test_there_is_one_example_per_system():
    assert {path.stem for path in EXAMPLES.glob("*.json")} >= set(NAMED)


@pytest.mark.parametrize("script", ["standard_map", "pendulum_swing_up", "own_function"])
def test_example_script_runs(script, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", [script])
    runpy.run_path(str(EXAMPLES / f"{script}.py"), run_name="__main__")
    assert "verified" in capsys.readouterr().out

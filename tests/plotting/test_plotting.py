"""Plots show the arrays of a result where the states are, whole, and without global state."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from problems import doubling, made, standard_map

import lmdsl as lm
from lmdsl import plotting
from lmdsl.errors import MissingDependency
from lmdsl.machine import memory
from lmdsl.plotting import layers, runs
from lmdsl.plotting.view import View, number, plain, rectangles, segments

MATPLOTLIB = pytest.importorskip("matplotlib")
SIGNATURES = {"png": b"\x89PNG\r\n\x1a\n", "pdf": b"%PDF-", "svg": b"<?xml"}


def maze(**more):
    """Nothing is symmetric; every cause occurs: x rises, y drifts, a wall is to be avoided."""
    return {
        "format": "lmdsl/1",
        "name": "maze",
        "system": {
            "kind": "map",
            "next": {
                "x": "where(y > 0.95, x + 2, where(x > 0.85, x, x + 0.1*u))",
                "y": "where(x > 0.85, y, where(x < 0.05, y + 0.2, y + 0.1*v))",
            },
        },
        "state_box": {
            "x": {"low": 0, "high": 1, "cells": 10},
            "y": {"low": 0, "high": 1.2, "cells": 12},
        },
        "attractor": {"cells": [[3, 1]]},
        "avoid": {"boxes": [{"x": [0.5, 0.6], "y": [0, 0.6]}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}, "v": {"low": -1, "high": 0, "points": 2}},
        "stage_cost": "1 + 0.1*u**2 + x*y",
        "sampling": {"kind": "grid", "per_axis": 2},
        **more,
    }


def lorenz():
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "ode",
            "derivative": {"x": "10*(y - x)", "y": "28*x - y - x*z + u", "z": "x*y - 8/3*z"},
            "step": 0.1,
            "substeps": 10,
        },
        "state_box": {
            "x": {"low": -20, "high": 20, "cells": 10},
            "y": {"low": -28, "high": 28, "cells": 8},
            "z": {"low": 0, "high": 50, "cells": 6},
        },
        "attractor": {"cells": [[6, 5, 3]]},
        "control_grid": {"u": {"low": -60, "high": 60, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
    }


def logistic():
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "4.3*x*(1 - x) + u"}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 100}},
        "attractor": {"points": [[1 - 1 / 4.3]]},
        "control_grid": {"u": {"low": -0.05, "high": 0.05, "points": 11}},
        "stage_cost": "1 + u**2",
        "sampling": {"kind": "grid", "per_axis": 5},
    }


@pytest.fixture(scope="module")
def solved():
    """Results by name, each solved when first asked for."""
    known = {
        "maze": maze,
        "lorenz": lorenz,
        "logistic": logistic,
        "standard": lambda: standard_map(20),
        "refused": lambda: standard_map(20, gamma=50.0),
        "autonomous": doubling,
    }
    results = {}

    def of(name):
        if name not in results:
            results[name] = lm.solve(made(known[name]()))
        return results[name]

    return of


def drawn_at(ax, states):
    """Return what the image of axes shows at states, shape (r, 2), as a mouse would find it."""
    (picture,) = ax.images
    ax.get_figure().canvas.draw()
    values = []
    for x, y in ax.transData.transform(states):
        value = picture.get_cursor_data(SimpleNamespace(x=x, y=y))
        values.append(np.nan if value is None or np.ma.is_masked(value) else float(value))
    return np.array(values)


def shows(ax, result, values):
    cells = np.arange(result.partition.size)
    found = drawn_at(ax, result.partition.centres(cells))
    return np.allclose(found, values, rtol=1e-12, atol=0, equal_nan=True)


def stabilized_only(result, values):
    return np.where(result.cell_status == lm.CellStatus.STABILIZED, values, np.nan)


def patches(ax):
    return {patch.get_label(): patch for patch in ax.patches}


def test_every_cause_occurs(solved):
    every = set(lm.CellStatus) - {lm.CellStatus.BEYOND_GAMMA}
    assert set(solved("maze").cell_status) == every


def test_cost_lies_where_the_states_are(solved):
    result = solved("maze")
    ax = plotting.cost(result)
    expected = stabilized_only(result, result.value)
    assert shows(ax, result, expected)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x", "y")
    assert (ax.get_xlim(), ax.get_ylim()) == ((0, 1), (0, 1.2))
    assert ax.child_axes[0].get_ylabel() == "cost-to-go V"
    # Negative control: the same picture transposed, or upside down, is told apart.
    data = ax.images[0].get_array()
    for wrong in (data.T, data[::-1], data[:, ::-1]):
        ax.images[0].set_data(wrong)
        assert not shows(ax, result, expected)


def test_every_control_is_drawn(solved):
    result = solved("maze")
    for k, name in enumerate(("u", "v")):
        ax = plotting.control(result, name)
        u = result.control_vectors[np.maximum(result.control_index, 0), k]
        assert shows(ax, result, np.where(result.control_index >= 0, u, np.nan))
        assert ax.child_axes[0].get_ylabel() == f"control {name}"
    assert plotting.control(result).get_title() == "control u"
    with pytest.raises(lm.BadInput, match="'w' is no control"):
        plotting.control(result, "w")


def test_control_colours_are_centred_at_zero(solved):
    (picture,) = plotting.control(solved("maze"), "u").images
    low, zero, high = (picture.cmap(picture.norm(v)) for v in (-1, 0, 1))
    assert min(zero[:3]) > 0.9
    assert low[2] > low[0]
    assert high[0] > high[2]
    assert len(picture.cmap.colors) == 3


def test_uneven_levels_keep_their_values_and_labels():
    result = lm.solve(
        made(maze(control_grid={"u": {"values": [1, -1, 0, 0.01]}, "v": {"values": [-1]}}))
    )
    ax = plotting.control(result, "u")
    u = result.control_vectors[np.maximum(result.control_index, 0), 0]
    assert shows(ax, result, np.where(result.control_index >= 0, u, np.nan))
    labels = [t.get_text() for t in ax.child_axes[0].get_yticklabels()]
    assert labels == ["−1", "0", "0.01", "1"]
    plotting.control(result, "v").get_figure().canvas.draw()


def test_measure_is_logarithmic_and_its_zeros_are_lowest(solved):
    result = solved("maze")
    measure = result.measure.copy()
    inside = np.flatnonzero(result.cell_status == 1)
    measure[inside[0]], measure[inside[1]], measure[inside[2]] = 0.0, 1e-5, 1e3
    spoiled = replace(result, measure=measure)
    ax = plotting.measure(spoiled)
    (picture,) = ax.images
    assert type(picture.norm).__name__ == "LogNorm"
    assert shows(ax, result, stabilized_only(result, np.where(measure > 0, measure, 5e-6)))
    assert picture.cmap(picture.norm(5e-6)) == picture.cmap(picture.norm(1e-5))
    assert ax.child_axes[0].get_ylabel() == "Lyapunov measure"
    ax = plotting.measure(result)
    assert shows(ax, result, stabilized_only(result, result.measure))


@pytest.mark.parametrize("draw", [plotting.cost, plotting.control, plotting.measure])
def test_regions_cover_their_cells_and_no_other(solved, draw):
    result = solved("maze")
    found = patches(draw(result))
    centres = result.partition.centres(np.arange(result.partition.size))
    names = {0: "attractor", 2: "escapes", 3: "trapped", 4: "leads to these", 5: "avoid"}
    assert set(found) == set(names.values())
    for code, name in names.items():
        inside = found[name].get_path().contains_points(centres)
        assert (inside == (result.cell_status == code)).all(), name
    looks = {(p.get_facecolor(), p.get_hatch()) for p in found.values()}
    assert len(looks) == len(found)


def test_the_legend_names_the_causes(solved):
    legend = plotting.cost(solved("maze")).get_legend()
    assert [t.get_text() for t in legend.get_texts()] == [
        "escapes", "trapped", "leads to these", "avoid", "attractor",
    ]  # fmt: skip
    assert plotting.cost(solved("maze"), legend=False).get_legend() is None


def test_small_attractors_are_ringed():
    result = lm.solve(made(standard_map(100, sampling={"kind": "grid", "per_axis": 1}, gamma=1.0)))
    rings = [c for c in plotting.cost(result).collections if hasattr(c, "get_sizes")]
    where = np.array([c.get_offsets()[0] for c in rings])
    assert np.allclose(np.unique(where, axis=0), [[0.25, 0.5], [0.75, 0.5]], atol=0.011)


def test_rectangles_cover_a_mask_once():
    mask = np.random.default_rng(0).random((7, 5)) < 0.5
    boxes = rectangles(mask, np.arange(8.0), np.arange(6.0))
    seen = np.zeros(mask.shape, dtype=int)
    for box in boxes.astype(int):
        (a, c), (b, d) = box.min(axis=0), box.max(axis=0)
        seen[a:b, c:d] += 1
    assert (seen == mask).all()


def test_slices_take_the_right_cells(solved):
    result = solved("lorenz")
    p = result.partition
    for axes, at in ((None, None), (("z", "x"), {"y": -20.0}), (("y", "z"), {"x": 0.1})):
        ax = plotting.cost(result, axes=axes, at=at)
        names = axes or ("x", "y")
        kept = [p.names.index(name) for name in names]
        (hidden,) = set(range(3)) - set(kept)
        level = p.centres(np.flatnonzero(result.cell_status == 0))[0] if at is None else None
        held = level[hidden] if at is None else at[p.names[hidden]]
        centres = p.centres(np.arange(p.size))
        on = np.abs(centres[:, hidden] - held) < p.width[hidden] / 2
        expected = stabilized_only(result, result.value)[on]
        assert np.isfinite(expected).any()
        assert np.allclose(drawn_at(ax, centres[on][:, kept]), expected, equal_nan=True)
        assert (ax.get_xlabel(), ax.get_ylabel()) == names
        assert f"{p.names[hidden]} ≈ " in ax.get_title()


def test_a_line_through_three_dimensions(solved):
    result = solved("lorenz")
    ax = plotting.cost(result, axes=("z",), at={"x": -19, "y": 20})
    (line,) = [p for p in ax.patches if type(p).__name__ == "StepPatch"]
    cells = result.partition.locate(
        [np.full(6, -19.0), np.full(6, 20.0), np.arange(6) * 50 / 6 + 1]
    )
    expected = stabilized_only(result, result.value)[cells]
    assert np.array_equal(line.get_data().values, expected, equal_nan=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": ("x", "w")}, "'w' is not an axis"),
        ({"axes": ("x", "x")}, "different axes"),
        ({"axes": ("x", "y", "z")}, "one or two"),
        ({"axes": ()}, "one or two"),
        ({"at": {"x": 0}}, "only axes that are not shown"),
        ({"at": {"z": 51}}, "outside the state box"),
        ({"at": {"z": float("nan")}}, "outside the state box"),
    ],
)
def test_impossible_slices_are_refused(solved, options, message):
    with pytest.raises(lm.BadInput, match=message):
        plotting.figure(solved("lorenz"), **options)


def test_one_dimension_is_drawn_as_steps(solved):
    result = solved("logistic")
    cases = (
        (plotting.cost, stabilized_only(result, result.value), "cost-to-go V"),
        (plotting.measure, stabilized_only(result, result.measure), "Lyapunov measure"),
        (
            plotting.control,
            stabilized_only(result, result.control_vectors[result.control_index, 0]),
            "control u",
        ),
    )
    for draw, expected, label in cases:
        ax = draw(result)
        (line,) = [p for p in ax.patches if type(p).__name__ == "StepPatch"]
        assert np.array_equal(line.get_data().values, expected, equal_nan=True)
        assert np.allclose(line.get_data().edges, np.linspace(0, 1, 101))
        assert ax.get_ylabel() == label
        assert {"attractor", "escapes"} <= set(patches(ax))
        (left, right) = np.ptp(patches(ax)["attractor"].get_path().vertices, axis=0)
        assert (left, right) == (pytest.approx(0.01), 1)


def test_portrait_follows_the_true_map(solved):
    result = solved("standard")
    ax = plotting.portrait(result, control=1.0, starts=3, steps=5)
    assert ax.get_title() == "map at u = 1"
    dots = np.asarray(ax.collections[0].get_offsets())
    assert len(dots) == 9 * 6
    x, y = dots.T
    kick = 0.25 * np.sin(2 * np.pi * x)
    images = np.stack([(x + y + kick) % 1, (y + kick) % 1], axis=-1)
    distance = np.abs(images[:, None] - dots[None]).max(axis=-1).min(axis=1)
    assert (distance < 1e-12).sum() == 9 * 5  # all but the last of each run
    assert "attractor" in patches(ax)


def test_portrait_of_a_problem_and_its_controls(solved):
    problem = made(maze())
    assert plotting.portrait(problem).get_title() == "map at u = 0, v = 0"
    assert plotting.portrait(problem, {"v": -1, "u": 0.5}).get_title() == "map at u = 0.5, v = −1"
    assert plotting.portrait(problem, [1, 2]).get_title() == "map at u = 1, v = 2"
    for wrong in (1.0, [1, np.nan], {"u": 1}):
        with pytest.raises(lm.BadInput, match="control"):
            plotting.portrait(problem, wrong)
    with pytest.raises(lm.BadInput, match="two axes"):
        plotting.portrait(problem, axes=("x",))
    assert plotting.portrait(solved("autonomous")).get_title() == "map"


def test_portrait_of_one_dimension_is_a_cobweb(solved):
    ax = plotting.portrait(solved("logistic"), 0.01)
    diagonal, graph, web = ax.lines
    assert np.array_equal(*diagonal.get_data())
    x, y = graph.get_data()
    assert np.allclose(y, 4.3 * x * (1 - x) + 0.01)
    u, v = web.get_data()
    assert np.allclose(v[1::2], 4.3 * u[1::2] * (1 - u[1::2]) + 0.01)
    assert np.array_equal(u[::2], v[::2])


def test_lines_of_an_ode_pass_through_the_states_of_the_model(solved):
    result = solved("lorenz")
    x = np.array([[5.0, 5.0, 20.0], [-19.0, 0.0, 30.0]])
    coarse, fine = (runs.constant_map(result.problem, fine) for fine in (False, True))
    u = np.full((2, 1), 30.0)
    image = x
    for _ in range(runs.PIECES):
        image = fine(image, u)
    assert np.allclose(image, coarse(x, u), rtol=1e-3)
    points, last, pieces = runs.closed_loop(result, x, steps=50, seed=0)
    for k in range(2):
        path = result.closed_loop.path(x[k], 50)
        assert np.allclose(points[::pieces, k][: len(path)], path)
        assert (result.partition.locate(list(path[-1:].T)) == last[k]).all()


def test_trajectories_are_the_closed_loop(solved):
    result = solved("standard")
    starts = np.array([[0.1, 0.9], [0.6, 0.2], [0.25, 0.5]])
    ax = plotting.trajectories(result, starts=starts)
    assert ax.get_title() == "closed loop, 3 of 3 runs reach A"
    dots = np.concatenate([np.asarray(c.get_offsets()) for c in ax.collections])
    for start in starts:
        for state in result.closed_loop.path(start, 500):
            assert np.nanmin(np.abs(dots - state).max(axis=1)) < 1e-12
    assert "attractor" in patches(ax)
    first, second = (plotting.trajectories(result, seed=3) for _ in range(2))
    assert np.array_equal(first.collections[0].get_paths()[0].vertices,
                          second.collections[0].get_paths()[0].vertices)  # fmt: skip
    for wrong in (0, [0.1, 0.2], [[0.1]]):
        with pytest.raises(lm.BadInput, match="starts"):
            plotting.trajectories(result, starts=wrong)


def test_lost_runs_are_marked(solved):
    result = solved("maze")
    ax = plotting.trajectories(result, starts=[[0.55, 0.1], [0.15, 0.15]])
    assert ax.get_title() == "closed loop, 1 of 2 runs reach A"
    ends, crosses = (c.get_offsets() for c in ax.collections if c.get_zorder() == 4)
    assert len(ends) == 1
    assert np.allclose(crosses, [[0.55, 0.1]])


def test_lines_break_where_an_axis_wraps():
    problem = made(standard_map(20))
    partition = lm.solve(problem).partition
    view = View.of(partition, np.arange(400) == 0)
    points = np.array([[[0.9, 0.5]], [[0.1, 0.6]], [[0.2, 0.6]], [[np.nan, np.nan]]])
    pieces, run = segments(points, view)
    assert np.allclose(
        pieces,
        [[[0.9, 0.5], [1.1, 0.6]], [[0.1, 0.6], [0.2, 0.6]], [[-0.1, 0.5], [0.1, 0.6]]],
    )
    assert (run == 0).all()
    assert (np.abs(pieces[:, 1] - pieces[:, 0]) < 0.5).all()


def test_runs_of_one_dimension_go_over_the_step(solved):
    ax = plotting.trajectories(solved("logistic"), starts=[[0.3]])
    path = solved("logistic").closed_loop.path([0.3], 500)[:, 0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("step", "x")
    dots = np.asarray(next(c for c in ax.collections if c.get_zorder() == 2.2).get_offsets())
    assert np.array_equal(dots, np.stack([np.arange(len(path)), path], axis=-1))


def test_refusals_show_their_cause(solved):
    result = solved("refused")
    assert result.status == "not_stabilizable"
    ax = plotting.cost(result)
    assert ax.get_title() == "causes"
    assert set(patches(ax)) <= {"attractor", "no finite cost", "stabilizable"}
    assert "no finite cost" in patches(ax)
    for draw, word in (
        (plotting.control, "no controller"),
        (plotting.measure, "no Lyapunov measure"),
        (plotting.trajectories, "no controller"),
    ):
        assert word in [t.get_text() for t in draw(result).texts]
    page = plotting.figure(result)
    assert [ax.get_title() for ax in page.axes[:2]] == ["map at u = 0", "causes"]


def test_an_empty_stabilizable_set_is_drawn():
    result = lm.solve(made(maze(system={"kind": "map", "next": {"x": "x + 5", "y": "y"}})))
    assert result.status == "not_stabilizable"
    assert set(patches(plotting.cost(result))) == {"attractor", "avoid", "escapes"}
    plotting.figure(result).canvas.draw()


@pytest.mark.parametrize("name", ["maze", "lorenz", "logistic", "autonomous"])
def test_figure_has_every_panel(solved, name):
    result = solved(name)
    page = plotting.figure(result)
    titles = [ax.get_title().split(" (")[0] for ax in page.axes]
    names = result.problem.controls
    optimal = "optimal cost" if names else "cost"
    for title in (optimal, *(f"control {u}" for u in names), "Lyapunov measure"):
        assert title in titles
    assert any(t.startswith("closed loop") for t in titles)
    numbers = [t.get_text() for t in page.axes[-1].texts]
    assert {"verified", number(result.gamma), number(result.cost, 6)} <= set(numbers)
    assert any("finite model" in text for text in numbers)


@pytest.mark.parametrize("kind", ["png", "pdf", "svg"])
def test_figure_is_written_whole(solved, tmp_path, kind):
    path = tmp_path / f"figure.{kind.upper() if kind == 'png' else kind}"
    plotting.figure(solved("autonomous"), path)
    assert path.read_bytes().startswith(SIGNATURES[kind])
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_written_where_it_cannot_be(solved, tmp_path):
    for path in ("figure.gif", "figure", "", "missing/figure.png"):
        with pytest.raises(lm.BadInput):
            plotting.figure(solved("autonomous"), tmp_path / path)
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_the_fix_is_named(solved, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    for draw in (plotting.portrait, plotting.cost, plotting.figure):
        with pytest.raises(MissingDependency) as caught:
            draw(solved("maze"))
        assert str(caught.value) == 'plots need matplotlib: pip install "lmdsl[plot]"'


def test_pyplot_is_never_imported(tmp_path):
    code = f"""
import sys
import lmdsl as lm
from lmdsl import plotting
assert not any(m.split(".")[0] == "matplotlib" for m in sys.modules)
data = {doubling()!r}
plotting.figure(lm.solve(lm.Problem.model_validate(data)), {str(tmp_path / "a.png")!r})
assert "matplotlib.figure" in sys.modules
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_given_axes_are_used(solved):
    page = layers.blank(2, 1)
    left, right = page.subplots(1, 2)
    assert plotting.cost(solved("maze"), left) is left
    assert plotting.measure(solved("maze"), right) is right
    page.canvas.draw()


def test_text_of_users_is_never_markup():
    assert plain("cost $\\frac{1}{$ 5$") == r"cost \$\frac{1}{\$ 5\$"
    assert plain("a\x00b\x1b[31m\n\tc\u202e\ud800d") == "ab[31m cd"
    assert plain("x" * 99) == "x" * 59 + "…"
    assert plain("") == ""


@pytest.mark.parametrize("name", ["$\\frac{", "$x$ and $\\undefined$", "漢字 \U0001f600", "$" * 80])
def test_odd_names_are_drawn_as_they_are(name, tmp_path):
    result = lm.solve(made(doubling(name=name)))
    page = plotting.figure(result, tmp_path / "a.pdf")
    (title,) = [t for t in page.texts if t.get_text()]
    shown, is_math = title._preprocess_math(title.get_text())
    assert shown == name[:100]
    assert is_math is False


def test_a_loaded_result_is_drawn_the_same(solved, tmp_path):
    result = solved("maze")
    result.save(tmp_path / "out")
    again = lm.Result.load(tmp_path / "out")
    first, second = (plotting.cost(r).images[0].get_array() for r in (result, again))
    assert np.array_equal(first.filled(-1), second.filled(-1))
    assert len(plotting.trajectories(again).collections) > 3


def test_a_function_that_was_not_stored_leaves_its_panels_empty(tmp_path):
    data = copy.deepcopy(doubling())
    data["system"] = lm.systems.FunctionSystem(next=lambda x: {"x": 2 * x})
    lm.solve(made(data)).save(tmp_path / "out")
    page = plotting.figure(lm.Result.load(tmp_path / "out"), tmp_path / "a.png")
    assert any("Python function" in " ".join(t.get_text().split()) for t in page.axes[0].texts)


def test_a_million_cells_are_drawn_in_bounded_work():
    from lmdsl.model.grid.partition import Partition

    data = standard_map(1000)
    partition = Partition.of(made(data))
    noise = np.random.default_rng(0).random(partition.size)
    view = View.of(partition, np.arange(partition.size) == 1234)
    ax = layers.frame(None, view, "")
    layers.scalar(ax, view, view.slice(noise), "V", "viridis")
    layers.regions(ax, view, view.slice((noise < 0.5) * 1 + 1), legend=True)
    ax.get_figure().canvas.draw()
    assert len(ax.images) == 2  # too many runs for outlines: regions become images
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["escapes"]


@pytest.mark.parametrize("draw", [lm.plotting.figure, lm.plotting.cost, lm.plotting.measure])
def test_a_plot_that_does_not_fit_is_refused(monkeypatch, draw):
    result = lm.solve(made(standard_map(400, 1.0)))
    monkeypatch.setattr(memory, "available", lambda: memory.Room(2**24, "a test"))
    with pytest.raises(lm.BadInput, match=r"plots?\) and 16\.8 MB are available \(a test\)"):
        draw(result)


PEAK = """
import lmdsl as lm
from lmdsl import memory, plotting

def peak():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))

asked, require = [0], memory.require
memory.require = lambda estimate, what: (asked.append(estimate), require(estimate, what))
result = lm.Result.load("out")
before, asked[:] = peak(), [0]
plotting.figure(result, "a.{}")
print(peak() - before, max(asked))
"""


@pytest.mark.long
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="Linux")
@pytest.mark.parametrize("kind", ["png", "pdf", "svg"])
def test_the_estimate_of_a_plot_is_an_upper_bound(tmp_path, kind):
    data = standard_map(900, 1.0)
    scattered = {"x": "0.9*x + 2*max(0, sin(1e6*x*y + 1e5*x))", "y": "0.9*y"}
    data["system"] = {"kind": "map", "next": scattered}
    data["state_box"] = {k: {"low": -1, "high": 1, "cells": 900} for k in "xy"}
    data["attractor"] = {"boxes": [{"x": [-0.1, 0.1], "y": [-0.1, 0.1]}]}
    data["stage_cost"] = "1"
    data["control_grid"], data["sampling"] = {"u": {"values": [0]}}, {"kind": "grid", "per_axis": 1}
    lm.solve(made(data)).save(tmp_path / "out")
    done = subprocess.run([sys.executable, "-c", PEAK.format(kind)], cwd=tmp_path, check=True,
                          env={**os.environ, "PYTHONPATH": str(Path(lm.__file__).parents[1])},
                          capture_output=True, text=True, timeout=600)  # fmt: skip
    taken, estimate = map(float, done.stdout.split())
    assert taken < estimate < 4 * taken

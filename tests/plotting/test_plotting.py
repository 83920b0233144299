"""Plots show the arrays of a result where the states are, whole, and without global state."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pictures import maze, patches
from problems import made, standard_map

import lmdsl as lm
from lmdsl import plotting
from lmdsl.plotting.view import rectangles

pytest.importorskip("matplotlib")


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
